"""The project as a whole: start-up, imports, dependencies, sizes, stray paths."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from rl_yardstick.machine_code.compiling import COMPILED

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / "rl_yardstick"
PACKAGES = sorted(path.parent.name for path in HOUSE.glob("*/__init__.py"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def sources() -> list[Path]:
    """Every module of the package, and the scripts beside it."""
    return sorted([*HOUSE.rglob("*.py"), *ROOT.glob("*.py")])


def test_importing_a_package_is_cheap(tmp_path: Path) -> None:
    """Run from elsewhere, so it also shows that the installed project is this checkout."""
    heavy = "{'torch', 'numba', 'scipy', 'pandas', 'matplotlib', 'pygame', 'stable_baselines3'}"
    code = f"""
import importlib, sys
for name in sys.argv[1:]:
    module = importlib.import_module(f"rl_yardstick.{{name}}")
    print(module.__file__, *sorted({heavy} & sys.modules.keys()))
"""
    words = [sys.executable, "-c", code, *PACKAGES]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    expected = [str(HOUSE / package / "__init__.py") for package in PACKAGES]
    assert PACKAGES[-1] == "verdicts"
    expected[-1] += " scipy"  # it is SciPy's functions
    assert done.stdout.splitlines() == expected
    # Nor does a study's own process load what only its workers need.
    modules = "experiments.pool", "report.figures", "report.page"
    loads = "".join(f"import rl_yardstick.{name}\n" for name in modules)
    code = f"{loads}import sys\nsys.exit(not {{'torch', 'numba'}}.isdisjoint(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 0


def test_every_imported_library_is_a_declared_dependency() -> None:
    extras = PROJECT["optional-dependencies"]
    optional = [line for extra in extras if extra != "dev" for line in extras[extra]]
    lines = [*PROJECT["dependencies"], *optional]
    declared = {canonicalize_name(Requirement(line).name) for line in lines}
    # Gymnasium's extras bring it, in the version that Gymnasium wants.
    declared.add(canonicalize_name("pygame-ce"))
    providers = importlib.metadata.packages_distributions()
    known = {HOUSE.name, *(command.stem for command in ROOT.glob("*.py")), *sys.stdlib_module_names}
    undeclared = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources()
        for name in imported_names(path) - known
        if declared.isdisjoint(canonicalize_name(provider) for provider in providers.get(name, []))
    }
    assert undeclared == set()


def imported_names(path: Path) -> set[str]:
    """Top-level names of all modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def test_no_module_is_longer_than_900_lines() -> None:
    assert [path for path in sources() if path.read_text().count("\n") > 900] == []


# Runs ``train.py`` as its command line says, and prints the files whose functions were called: by
# whom, and in which thread, does not matter. What runs when a module is imported does not count.
ENTERED = """
import atexit, inspect, runpy, sys, threading
import matplotlib.pyplot, numba, pandas, stable_baselines3  # without being looked at, which is slow

def note(frame, event, argument):
    if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:
        entered.add(frame.f_code.co_filename)

entered = set()
atexit.register(lambda: print(*sorted(entered), sep="\\n", file=sys.stderr))
threading.setprofile(note)
sys.setprofile(note)
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
# 56 where the machine code is there; some more where it is compiled, or takes so long that states
# are saved.
MOST_FILES_ENTERED = 64


def test_a_run_enters_no_more_files_than_it_did(tmp_path: Path) -> None:
    """A ratchet: what one has to open to follow one run may become less, and never more."""
    command = [sys.executable, "-c", ENTERED, ROOT / "train.py", "--env", "FrozenLake-v1"]
    command += ["--algo", "qlearning", "-n", "1000", "--seed", "0"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    files = [line for line in done.stderr.splitlines() if line.startswith(f"{HOUSE}/")]
    assert 0 < len(files) <= MOST_FILES_ENTERED, "\n".join(files)


def test_the_tests_of_daily_work_are_there() -> None:
    names = (ROOT / "tests" / "quick.txt").read_text().split()
    assert len(names) > 100
    for name in names:
        path, _, function = name.partition("::")
        assert f"def {function}(" in (ROOT / path).read_text(), f"{name} is not there"


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
    folders = (HOUSE.name, "studies", "tests", "benchmarks", "docs", ".ci")
    inside = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    beside = [path for path in ROOT.iterdir() if path.is_file()]
    return (path for path in [*inside, *beside] if path.suffix in {*text, ""})


def test_all_that_is_compiled_stands_where_the_digest_of_machine_code_looks() -> None:
    """Compiled functions, and what is compiled into them, are sources of `mdp` and `agents`."""
    form = re.compile(r"^\s*(import numba|from numba)|^@?(inlined|kernel|compiled)$", re.M)
    compiling = [path for path in HOUSE.rglob("*.py") if form.search(path.read_text())]
    assert {path.relative_to(HOUSE).parts[0] for path in compiling} == set(COMPILED)
