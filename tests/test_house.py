"""The project as a whole: start-up, imports, dependencies, sizes, stray paths, other systems."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from machine_code.sources import kept_packages

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (
    "safe_files",
    "machine_code",
    "mdp",
    "verdicts",
    "envs",
    "agents",
    "pipeline",
    "diagnosis",
    "experiments",
    "tuning",
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


def test_every_module_can_be_imported(tmp_path: Path) -> None:
    """In any order, since no two of them need each other."""
    names = [module_name(path) for path in sources()]
    code = f"import importlib\nfor name in {names}:\n    importlib.import_module(name)"
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
    for name in imported_names(path):
        if name not in own and name not in sys.stdlib_module_names:
            yield name


def imported_names(path: Path) -> set[str]:
    """Top-level names of all modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def imported_modules(path: Path, modules: frozenset[str]) -> set[str]:
    """Those of ``modules`` that a file imports: anywhere in it, and for types alone too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                found.add(inside if inside in modules else node.module)
    return (found & modules) - {module_name(path)}


def import_graph() -> dict[str, set[str]]:
    """The project's modules, each with those that it imports."""
    files = {module_name(path): path for path in sources()}
    modules = frozenset(files)
    return {name: imported_modules(path, modules) for name, path in files.items()}


def cycles(graph: dict[str, set[str]]) -> list[str]:
    """A shortest way round through each group of modules that need each other."""
    found: dict[frozenset[str], str] = {}
    for start in sorted(graph):
        ways = deque([[start]])
        seen = set()
        while ways:
            way = ways.popleft()
            if start in graph[way[-1]]:
                found.setdefault(frozenset(way), " -> ".join([*way, start]))
                break
            following = sorted(graph[way[-1]] - seen)
            seen |= set(following)
            ways.extend([*way, name] for name in following)
    return list(found.values())


def test_cycles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c", "d"}, "c": {"a"}, "d": {"e"}, "e": {"d"}, "f": {"a"}}
    assert cycles(graph) == ["a -> b -> c -> a", "d -> e -> d"]


def test_no_module_needs_one_that_needs_it() -> None:
    assert "\n".join(cycles(import_graph())) == ""


def test_no_module_has_the_name_of_one_of_pythons_own() -> None:
    parts = {part for path in sources() for part in module_name(path).split(".")}
    assert parts & sys.stdlib_module_names == set()


def test_only_commands_parse_arguments() -> None:
    users = [module_name(path) for path in sources() if "argparse" in imported_names(path)]
    assert users
    assert [name for name in users if not name.startswith("commands.")] == []


def test_no_module_is_longer_than_900_lines() -> None:
    lengths = {module_name(path): len(path.read_text().splitlines()) for path in sources()}
    assert {name: length for name, length in lengths.items() if length > 900} == {}


# Runs ``train.py`` as its command line says, and prints the files whose functions were called: by
# whom, and in which thread, does not matter. What runs when a module is imported does not count.
ENTERED = """
import inspect, runpy, sys, threading

def note(frame, event, argument):
    if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:
        entered.add(frame.f_code.co_filename)

entered = set()
script, *sys.argv[1:] = sys.argv[1:]
sys.argv[0] = "train.py"
threading.setprofile(note)
sys.setprofile(note)
try:
    runpy.run_path(script, run_name="__main__")
except SystemExit as stop:
    assert stop.code == 0, stop.code
finally:
    sys.setprofile(None)
print(*sorted(entered), sep="\\n", file=sys.stderr)
"""
# 76 where the machine code is there, 79 where it is compiled, and some more where that takes so
# long that states are saved.
MOST_FILES_ENTERED = 84


def files_entered(tmp_path: Path) -> list[str]:
    """The files of ours that a run on a table enters functions of, without those of tests."""
    command = ["--env", "FrozenLake-v1", "--algo", "qlearning", "-n", "1000", "--seed", "0"]
    done = subprocess.run(
        [sys.executable, "-c", ENTERED, ROOT / "train.py", *command],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    folders = {str(ROOT / package) for package in PACKAGES}
    return [
        line
        for line in done.stderr.splitlines()
        if any(line.startswith(f"{folder}/") for folder in folders)
    ]


def test_a_run_enters_no_more_files_than_it_did(tmp_path: Path) -> None:
    """A ratchet: what one has to open to follow one run may become less, and never more."""
    files = files_entered(tmp_path)
    assert len(files) <= MOST_FILES_ENTERED, "\n".join(files)


def test_the_tests_of_daily_work_are_there() -> None:
    names = (ROOT / "tests" / "quick.txt").read_text().split()
    assert len(names) > 100
    for name in names:
        path, _, function = name.partition("::")
        assert f"def {function}(" in (ROOT / path).read_text(), f"{name}: see tests/mutation"


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
    data = ("hyperparams", "studies")
    folders = (*PACKAGES, *data, "tests", "benchmarks", "docs", ".ci")
    inside = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    beside = [path for path in ROOT.iterdir() if path.is_file()]
    return (path for path in [*inside, *beside] if path.suffix in {*text, ""})


def test_all_that_is_compiled_stands_where_the_digest_of_machine_code_looks() -> None:
    """Compiled functions, and what is compiled into them, are sources of `mdp` and `agents`."""
    importlib.import_module("agents")
    importlib.import_module("mdp")
    kept = kept_packages()

    compiling = {
        str(path.relative_to(ROOT))
        for path in sources()
        if re.search(
            r"^\s*(import numba|from numba)|^@?(inlined|kernel|compiled)$", path.read_text(), re.M
        )
    }
    assert {Path(name).parts[0] for name in compiling} == {"machine_code", *kept}
    assert set(kept["agents"]) == {"agents", "machine_code", "mdp"}


# === what Windows understands otherwise ===========================================================

# `make lint` lets mypy read the packages as on Windows, which finds every module and function that
# Windows has not. Here is what is there too, but is or does something else.

# What each of them does on Windows.
ELSEWHERE = {
    "os.kill": "ends the process, or sends Ctrl-C to it, whatever the signal",
    "os.rename": "refuses where there is a file; use os.replace",
    "os.symlink": "needs a privilege",
    "os.chmod": "knows no permissions but read-only",
    "os.system": "is another shell",
    "os.popen": "is another shell",
    ".rename": "refuses where there is a file; use replace",
    ".symlink_to": "needs a privilege",
    ".chmod": "knows no permissions but read-only",
}

ABSENT = ("/tmp", "/dev/", "/proc")  # noqa: S108  # nothing is written there

# Where one of them stands all the same, and why.
GUARDED = {
    ("experiments/child_processes.py", "os.kill"): "asks for the platform before it",
    ("experiments/run_limits.py", "/proc"): "refuses to measure on Windows",
    ("machine_code/cache.py", ".chmod"): "modes are neither set nor checked on Windows",
    ("pipeline/locks.py", "os.kill"): "asks _winapi on Windows, before it",
    ("pipeline/locks.py", "/proc"): "does without where there is none",
    ("pipeline/runs.py", "/proc"): "does without where there is none",
}


def name_of(function: ast.expr) -> str:
    """``module.function`` where a name stands before the dot, else ``.method``.

    A member of a zip is opened as bytes: ``archive`` counts as such a name.
    """
    if isinstance(function, ast.Name):
        return function.id
    if not isinstance(function, ast.Attribute):
        return ""
    is_module = isinstance(function.value, ast.Name) and function.value.id in {
        "os",
        "Image",
        "archive",
    }
    return f"{function.value.id if is_module else ''}.{function.attr}"


def opens_text_anyhow(call: ast.Call) -> bool:
    """Whether a text file is opened in whatever encoding the country has."""
    name = name_of(call.func)
    if "encoding" in {keyword.arg for keyword in call.keywords}:
        return False
    if name in {".read_text", ".write_text"}:
        return len(call.args) < (1 if name == ".read_text" else 2)
    if name not in {"open", ".open"}:
        return False
    modes = [keyword.value for keyword in call.keywords if keyword.arg == "mode"]
    modes += call.args[1:2] if name == "open" else call.args[:1]
    return not any(isinstance(mode, ast.Constant) and "b" in str(mode.value) for mode in modes)


def complaints(path: str, source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and opens_text_anyhow(node):
            yield f"{path}:{node.lineno}: say encoding=, which Windows does not take for UTF-8"
        if isinstance(node, ast.Attribute):
            for name in {name_of(node), f".{node.attr}"} & ELSEWHERE.keys():
                if (path, name) not in GUARDED:
                    yield f"{path}:{node.lineno}: {name} {ELSEWHERE[name]} on Windows"
        if isinstance(node, ast.Constant):
            for name in filter(str(node.value).startswith, ABSENT):
                if (path, name) not in GUARDED:
                    yield f"{path}:{node.lineno}: there is no {node.value} on Windows"


def test_nothing_that_windows_understands_otherwise():
    found = [
        complaint
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for complaint in complaints(
            path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        )
    ]
    assert "\n".join(found) == ""


@pytest.mark.parametrize(
    ("source", "n"),
    [
        ("os.kill(pid, 0)", 1),
        ("from os import kill", 0),  # nobody does that here
        ("draft.rename(path)", 1),
        ("open(path)", 1),
        ("open(path, 'w')", 1),
        ("open(path, 'wb')", 0),
        ("open(path, mode='rb')", 0),
        ("open(path, encoding='utf-8')", 0),
        ("path.open()", 1),
        ("path.open('rb+')", 0),
        ("Image.open(path)", 0),
        ("path.read_text()", 1),
        ("path.read_text('utf-8')", 0),
        ("path.write_text('a')", 1),
        ("path.write_text('a', encoding='utf-8')", 0),
        ("folder = '/dev/null'", 1),
    ],
)
def test_what_is_found(source, n):
    assert len(list(complaints("x.py", source))) == n


def test_every_exception_is_still_needed():
    for path, name in GUARDED:
        assert name in (ROOT / path).read_text(encoding="utf-8")
