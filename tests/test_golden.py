"""A sample of what `make golden` compares, and how it tells differences."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
SAMPLE = (
    "run table*",
    "plan FrozenLake-v1 *",
    "train FrozenLake-v1 qlearning",
)


def test_a_sample_is_as_it_was_recorded():
    done = subprocess.run(
        [sys.executable, GOLDEN, "--only", *SAMPLE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert int(done.stdout.split()[0]) == 7, "most of the sample is not there any more"


@pytest.fixture
def told():
    """The lines for one entry that was ``was`` and is ``now``, where things are as they were."""
    program = runpy.run_path(str(GOLDEN / "__main__.py"), run_name="golden")
    facts = program["facts"]()

    def tell(was, now, holds="anywhere", changed=None):
        class Found:
            values = {} if now is None else {"entry": now}

        entries = {"anywhere": {}, "python": {}, "here": {}}
        if was is not None:
            entries[holds]["entry"] = was
        recorded = {"facts": {**facts, **(changed or {})}, "entries": entries}
        return list(program["differences"](recorded, Found, ["*"]))

    return tell


def test_each_difference_is_told_in_a_line(told):
    assert told("1", "1") == []
    assert told("1", "2") == ['entry: was "1", is "2"']
    assert told(["a", "b", "c"], ["a", "x", "c", "d"]) == [
        'entry: was "b", is "x"',
        'entry: was nothing, is "d"',
    ]
    assert told("1", None) == ["entry: is gone"]
    (new,) = told(None, "1")
    assert new.startswith("entry: is new")


def test_what_depends_on_the_machine_is_no_difference_on_another(told):
    other = {"capability": "AVX1024"}
    assert told("1", "2", changed=other) == ['entry: was "1", is "2"']
    (line,) = told("1", "2", holds="here", changed=other)
    assert line.startswith("not comparable here: 1 entries that depend on capability AVX1024, here")
    assert told("1", "1", holds="here", changed=other) == []
    assert told("1", "2", holds="python", changed=other) == ['entry: was "1", is "2"']
    (line,) = told("1", "2", holds="python", changed={"python": "3.1"})
    assert line.startswith("not comparable here: ")
