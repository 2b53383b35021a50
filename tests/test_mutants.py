"""The tool that makes deliberate errors, on a package so small that all is known of it."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parent / "mutation"

LIMITS = '''"""Made up."""


def clip(value: int, low: int, high: int) -> int:
    """Not an error: the 1 of a docstring."""
    if value > high:
        return high
    return max(value, low)
'''
SIZES = '''"""Made up."""


def doubled(value):
    return 2 * value
'''
# It sleeps, so that waiting for it takes no processor.
COUNTDOWN = """from time import sleep


def countdown(n):
    while n > 0 and not sleep(0.1):
        n -= 1
    return n
"""
GOOD = """from toy import limits


def test_clip():
    assert [limits.clip(value, 1, 3) for value in (0, 1, 2, 3, 4)] == [1, 1, 2, 3, 3]
"""
USELESS = """from toy import sizes


def test_doubled_can_be_called():
    sizes.doubled(1)
"""


@pytest.fixture
def toy(tmp_path):
    """A checkout whose package has a module with a good test and one with a useless test."""
    files = {
        "toy/__init__.py": "",
        "toy/limits.py": LIMITS,
        "toy/sizes.py": SIZES,
        "tests/toy/test_limits.py": GOOD,
        "tests/toy/test_sizes.py": USELESS,
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.fixture
def drawing(monkeypatch):
    monkeypatch.syspath_prepend(TOOL)
    import drawing

    return drawing


def run(root, *arguments):
    command = [sys.executable, str(TOOL), "toy", "--root", str(root), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_what_a_good_test_catches_and_a_useless_one_does_not(toy):
    before = {path: path.read_bytes() for path in toy.rglob("*") if path.is_file()}
    done = run(toy, "-n", "99")
    assert done.stderr == ""
    # The checkout itself is never touched.
    assert {path: path.read_bytes() for path in toy.rglob("*") if path.is_file()} == before
    *lines, last = done.stdout.splitlines()
    fates = dict(zip(lines[::2], (line.strip() for line in lines[1::2]), strict=True))
    of_limits = {error: fate for error, fate in fates.items() if error.startswith("toy/limits")}
    of_sizes = {error: fate for error, fate in fates.items() if error.startswith("toy/sizes")}
    assert of_limits == {
        # Nothing observable changes: at the limit itself both ways give the limit.
        "toy/limits.py:6: if value > high:  ->  if value >= high:": "SURVIVED",
        "toy/limits.py:6: if value > high: return high  ->  pass": (
            "caught by tests/toy/test_limits.py::test_clip"
        ),
        "toy/limits.py:7: return high  ->  return None": (
            "caught by tests/toy/test_limits.py::test_clip"
        ),
        "toy/limits.py:8: return max(value, low)  ->  return None": (
            "caught by tests/toy/test_limits.py::test_clip"
        ),
    }
    assert of_sizes == {
        "toy/sizes.py:5: return 2 * value  ->  return None": "SURVIVED",
        "toy/sizes.py:5: return 2 * value  ->  return 2 / value": "SURVIVED",
        "toy/sizes.py:5: return 2 * value  ->  return 3 * value": "SURVIVED",
    }
    assert last == "caught 3 of 7 (43 %)"


def test_tests_that_fail_without_any_error_count_nothing(toy):
    (toy / "tests/toy/test_sizes.py").write_text("def test_broken():\n    assert False\n")
    done = run(toy, "-n", "2")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == (
        "without any error, tests/toy/test_sizes.py::test_broken fails already\n"
    )


def test_a_hang_counts_as_caught(toy, drawing):
    import imports
    import running

    (toy / "toy/sizes.py").write_text(COUNTDOWN)
    (toy / "tests/toy/test_sizes.py").write_text(
        "from toy.sizes import countdown\n\n\ndef test_it():\n    assert countdown(3) == 0\n"
    )
    copy = running.Checkout(toy, toy.parent / "copy")
    errors = drawing.mutants_of("toy/sizes.py", COUNTDOWN.encode())
    [mutant] = [error for error in errors if error.new == "pass"]
    found = imports.Imports(toy, ["toy", "tests"])
    assert copy.judge(mutant, found, (), limit=5) == "a time-out"
    assert (copy.path / "toy/sizes.py").read_text() == COUNTDOWN


def test_the_same_seed_draws_the_same_errors(toy, drawing):
    first = drawing.draw(toy, "toy", 3, seed=1)
    assert len(first) == 3
    assert drawing.draw(toy, "toy", 3, seed=1) == first
    assert any(drawing.draw(toy, "toy", 3, seed=seed) != first for seed in range(2, 9))
    listed = run(toy, "-n", "3", "--seed", "1", "--list").stdout.splitlines()
    assert listed == [m.describe((toy / m.path).read_bytes()) for m in first]


@pytest.mark.parametrize(
    ("source", "errors"),
    [
        ("a < b", {"a <= b"}),
        ("a == b", {"a != b"}),
        ("a is not b", {"a is b"}),
        ("(a) not in b", {"(a) in b"}),
        ("(a) + (b)", {"(a) - (b)"}),
        ("a ** b", {"a * b"}),
        ("a and b", {"a or b"}),
        ("not a", {"a"}),
        ("-a", {"a"}),
        ("x += a", {"x -= a", "pass"}),
        ("x = 0", {"x = 1"}),
        ("x = 0.5", {"x = 1.5"}),
        ("x = True", {"x = False"}),
        ("x = 'word'", {'x = ""'}),
        ("x = ''", {'x = "XX"'}),
        ("x.y = a", {"pass"}),
        ("x = a.sum(keepdims=True)", {"x = a.sum(keepdims=False)"}),
        ("x = a[b:c]", {"x = a[:c]", "x = a[b:]"}),
        ("x = range(a)", {"x = range((a) - 1)"}),
        ("x = range(a, b)", {"x = range(a, (b) - 1)"}),
        ("x = a if b else c", {"x = a if not b else c"}),
        ("if a:\n  x = b", {"if not a:\n  x = b", "pass"}),
        ("while a:\n  break", {"while not a:\n  break", "while a:\n  continue"}),
        ("while a:\n  continue", {"while not a:\n  continue", "while a:\n  break"}),
        (
            "def f(x=None):\n  return x",
            {"def f(x=0):\n  return x", "def f(x=None):\n  return None"},
        ),
        ("def f(x):\n  x = a", {"def f(x):\n  pass"}),
        ("raise a", {"pass"}),
        ("a()", {"pass"}),
        # What cannot matter:
        ("x: 'Word'", set()),
        ("def f(x: 'Word') -> 'Word':\n  'docstring'", set()),
        ("def __repr__(self):\n  return 'word'", set()),
        ("__all__ = ['word']", set()),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n  import x", set()),
        ("assert a < b", set()),
        ("x = f'word {a}'", set()),
        ("logger.info('word')", set()),
        ("if verbose > 0:\n  print('word')", set()),
        ("add(a, help='word')", {"pass"}),
        ("x = cast('Word', a)", set()),
    ],
)
def test_errors_that_can_be_made(source, errors, drawing):
    found = drawing.mutants_of("m.py", source.encode())
    assert {m.applied_to(source.encode()).decode() for m in found} == errors
    assert len(found) == len(errors)


def test_positions_behind_letters_of_two_bytes(drawing):
    source = "x = ('ü', a < b)  # ü\ny = 1\n".encode()
    changed = {m.applied_to(source).decode() for m in drawing.mutants_of("m.py", source)}
    assert "x = ('ü', a <= b)  # ü\ny = 1\n" in changed
    assert "x = ('ü', a < b)  # ü\ny = 2\n" in changed


def test_imports_lead_through_names_that_a_package_loads_on_first_use(drawing):
    from imports import Imports

    imports = Imports(Path(__file__).parents[1], ["machine_code", "mdp", "verdicts", "tests"])
    distances = imports.distances("mdp/evaluation.py")
    assert distances["mdp/evaluation.py"] == 0
    assert distances["tests/mdp/test_evaluation.py"] == 1
    assert "verdicts/resampling.py" not in distances
    beneath = imports.beneath_machine_code()
    assert {"machine_code/compiling.py", "mdp/planning.py"} <= beneath
    assert "verdicts/resampling.py" not in beneath
