"""A sample of what `make golden` compares, and how it tells differences."""

import runpy
import subprocess
import sys
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
SAMPLE = ("run table", "plan FrozenLake-v1 *", "train FrozenLake-v1 qlearning")
PLACES = ("anywhere", "here")


def test_a_sample_is_as_it_was_recorded():
    words = [sys.executable, GOLDEN, "--only", *SAMPLE]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert int(done.stdout.split()[0]) == 6, "most of the sample is not there any more"


OTHER = {"capability": "AVX1024"}
SAID = ['entry: was "1", is "2"']
BOTH = ['entry: was "b", is "x"', 'entry: was nothing, is "d"']
ELSEWHERE = ["not comparable here: 1 entries that depend on capability AVX1024, here *"]
# What was recorded, where it holds, what is there now, facts that were others, and what is told.
ROWS = [
    ("1", "anywhere", "1", {}, []),
    ("1", "anywhere", "2", {}, SAID),
    ([*"abc"], "anywhere", [*"axcd"], {}, BOTH),
    ("1", "anywhere", None, {}, ["entry: is gone"]),
    (None, "anywhere", "1", {}, ["entry: is new; *"]),
    ("1", "anywhere", "2", OTHER, SAID),
    ("1", "here", "2", OTHER, ELSEWHERE),
    ("1", "here", "1", OTHER, []),
]


@pytest.mark.parametrize(("was", "holds", "now", "changed", "told"), ROWS)
def test_each_difference_is_told_in_a_line(was, holds, now, changed, told):
    program = runpy.run_path(str(GOLDEN / "__main__.py"), run_name="golden")
    entries = {place: {"entry": was} if was and place == holds else {} for place in PLACES}
    recorded = {"facts": {**program["facts"](), **changed}, "entries": entries}
    found = {"entry": (holds, now, 0.0)} if now else {}
    lines = list(program["differences"](recorded, found, ["*"]))
    assert len(lines) == len(told)
    assert all(map(fnmatchcase, lines, told)), lines
