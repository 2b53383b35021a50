"""The project as a whole: start-up, imports, declared dependencies, sizes, stray paths."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (
    "mdp",
    "verdicts",
    "envs",
    "agents",
    "pipeline",
    "experiments",
    "report",
    "commands",
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def sources() -> list[Path]:
    """Every module of the packages, and the commands beside them."""
    inside = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    return sorted([*inside, *ROOT.glob("*.py")])


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def python(code: str, cwd: Path) -> str:
    """Standard output of ``code`` in a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_is_cheap(package: str, tmp_path: Path) -> None:
    """Run from elsewhere, so it also shows that the installed project is this checkout."""
    heavy = "{'torch', 'numba', 'scipy', 'pandas', 'matplotlib', 'pygame', 'stable_baselines3'}"
    code = f"import sys, {package} as p; print(p.__file__, *sorted({heavy} & sys.modules.keys()))"
    assert python(code, cwd=tmp_path) == str(ROOT / package / "__init__.py")


def test_any_module_can_be_the_first_one_imported(tmp_path: Path) -> None:
    """Import cycles show only from some entry points, so each module takes its turn to be first."""
    names = [module_name(path) for path in sources()]
    code = f"""
import importlib, sys, traceback
import gymnasium, numba, matplotlib, pandas, scipy, stable_baselines3
registered = set(gymnasium.registry)
for name in {names}:
    for loaded in [m for m in sys.modules if m in {names}]:
        del sys.modules[loaded]
    for ours in set(gymnasium.registry) - registered:
        del gymnasium.registry[ours]
    try:
        importlib.import_module(name)
    except ImportError:
        print(name, traceback.format_exc())
"""
    assert python(code, cwd=tmp_path) == ""


def test_every_imported_library_is_a_declared_dependency() -> None:
    extras = PROJECT["optional-dependencies"]
    optional = [line for extra in extras if extra != "dev" for line in extras[extra]]
    lines = [*PROJECT["dependencies"], *optional]
    declared = {canonicalize_name(Requirement(line).name) for line in lines}
    # Gymnasium's extras bring it, in the version that Gymnasium wants.
    declared.add(canonicalize_name("pygame-ce"))
    providers = importlib.metadata.packages_distributions()
    undeclared = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources()
        for name in imported_libraries(path)
        if declared.isdisjoint(canonicalize_name(provider) for provider in providers.get(name, []))
    }
    assert undeclared == set()


def imported_libraries(path: Path) -> Iterator[str]:
    """Top-level names of the third-party modules that a file imports, anywhere in it."""
    own = {*PACKAGES, *(command.stem for command in ROOT.glob("*.py"))}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module]
        else:
            continue
        for top in {name.partition(".")[0] for name in names}:
            if top not in own and top not in sys.stdlib_module_names:
                yield top


def test_constraints_pin_a_version_inside_each_declared_range() -> None:
    pins = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            name, version = line.split("==")
            pins[canonicalize_name(name)] = Version(version)
    extras = PROJECT["optional-dependencies"].values()
    declared = [Requirement(line) for lines in (PROJECT["dependencies"], *extras) for line in lines]
    others = [one for one in declared if one.name != PROJECT["name"]]
    outside = [str(one) for one in others if pins[canonicalize_name(one.name)] not in one.specifier]
    assert outside == []
    assert all(version.local is None for version in pins.values())


def test_no_module_is_longer_than_300_lines() -> None:
    lengths = {module_name(path): len(path.read_text().splitlines()) for path in sources()}
    assert {name: length for name, length in lengths.items() if length > 300} == {}


def test_no_file_names_a_path_of_somebodys_machine() -> None:
    here = {str(ROOT), str(Path.home()), tempfile.gettempdir()}
    others = ["/home", "/root", "/Users", r"[A-Z]:\\Users"]
    prefixes = "|".join([*map(re.escape, here), *others])
    personal = re.compile(rf"(?<![\w.:])(?:{prefixes})[/\\]\w")
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in published_files()
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        if personal.search(line)
    ]
    assert found == []


def published_files() -> Iterator[Path]:
    """Every text file of the project, with or without git at hand."""
    text = {".py", ".md", ".yml", ".yaml", ".toml", ".txt", ".json", ".html", ".css", ".js", ".csv"}
    folders = (*PACKAGES, "hyperparams", "studies", "tests", "benchmarks", "docs", ".ci")
    inside = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    beside = [path for path in ROOT.iterdir() if path.is_file()]
    return (path for path in [*inside, *beside] if path.suffix in {*text, ""})
