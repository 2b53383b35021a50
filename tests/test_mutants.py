"""The tool that makes deliberate errors, on a package so small that all is known of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parent / "mutation"
SOURCE = '''"""Made up."""


def clip(value: int, low: int, high: int) -> int:
    """Not an error: the 1 of a docstring."""
    if value > high:
        return high
    return max(value, low)


def unused(value):
    return value
'''
TESTS = """from toy.a import clip


def test_clip():
    assert [clip(value, 1, 3) for value in (0, 1, 2, 3, 4)] == [1, 1, 2, 3, 3]


def test_broken():
    assert False
"""


def test_which_errors_are_caught(tmp_path):
    source, tests, record = (
        tmp_path / name for name in ("toy/a.py", "tests/toy/test_a.py", "record")
    )
    made = {source: SOURCE, tests: TESTS, tmp_path / "toy/__init__.py": ""}
    made[tmp_path / "pytest.ini"] = "[pytest]\nfilterwarnings = error\n"
    for path, text in made.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    command = [sys.executable, TOOL, "toy", "--root", tmp_path, "--record", record, "-n", "99"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    errors = json.loads(record.read_text())
    name = "tests/toy/test_a.py::test_"
    assert done.stderr == f"left out, as it fails without any error: {name}broken\n"
    assert {(line, new.strip(), fate) for _, line, _, new, fate in errors} == {
        # Nothing observable changes: at the limit itself both ways give the limit.
        (6, "if (value >= high):", "survived"),
        (6, "if (not value > high):", f"{name}clip"),
        (6, "pass", f"{name}clip"),
        (7, "return None", f"{name}clip"),
        (8, "return None", f"{name}clip"),
        (12, "return None", "survived"),
    }
    assert done.stdout.endswith("caught 4 of 6\n")
    assert source.read_text() == SOURCE


@pytest.mark.parametrize(
    ("source", "errors"),
    [
        ("x = a < b", {"x = (a <= b)"}),
        ("x = a and not b", {"x = (a or not b)", "x = a and (b)"}),
        ("x = (a) + True", {"x = (a - True)", "x = (a) + False"}),
        ("x += 0.5", {"x -= 0.5", "x += 1.5"}),
        ("x.y = range(a)", {"pass", "x.y = range((a) - 1)"}),
        ("while a:\n  break", {"while (not a):\n  break", "while a:\n  continue"}),
        ("def f(x=0):\n  raise a", {"def f(x=1):\n  raise a", "def f(x=0):\n  pass"}),
        ("x = ('ü', a < b)  # ü", {"x = ('', a < b)  # ü", "x = ('ü', (a <= b))  # ü"}),
        # What cannot matter:
        ("def f(x: 'Word'):\n  'docstring'\ndef __repr__(self):\n  return 'word'", set()),
        ("assert a < b\nx = f'word {a}', cast('Word', a)\nlogger.info('word')", set()),
        ("if verbose > 0:\n  print('word')", set()),
    ],
)
def test_errors_that_can_be_made(source, errors, monkeypatch):
    monkeypatch.syspath_prepend(TOOL)
    from drawing import mutants_of

    assert {m.applied_to(source) for m in mutants_of("m.py", source)} == errors
