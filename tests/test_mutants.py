"""Which deliberate errors the tool of `tests/mutation` makes of a line."""

from pathlib import Path

import pytest

TOOL = Path(__file__).parent / "mutation"


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
