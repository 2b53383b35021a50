"""Nothing on the way of a command that some system lacks, or understands in its own way.

`make lint` lets mypy read the packages as on Windows, which finds every module and function that
Windows has not. Here is what is there too, but is or does something else.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = [
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
]

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
