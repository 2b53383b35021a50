"""A sample of the campaigns of kills: nothing differs, and nothing is left."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import compare

ROOT = Path(compare.__file__).parent
has_compiler = sys.platform == "linux" and shutil.which("cc") is not None
at_calls = pytest.mark.skipif(not has_compiler, reason="needs Linux and a C compiler")


@pytest.mark.parametrize(
    "words",
    [
        ["--only", "qlearning on Warehouse-v0"],  # networks take several times as long
        pytest.param(["--at-calls", "--only", "a pack"], marks=at_calls),
    ],
)
def test_killed_commands_end_as_they_would_have(tmp_path, words):
    script = ROOT / "benchmarks" / "fault_campaign.py"
    words = ["--kills", "2", "--jobs", "2", *words]
    result = subprocess.run(
        [sys.executable, str(script), *words],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(script.parent)]),
            "TMPDIR": str(tmp_path),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    *_, total, _ = result.stdout.splitlines()
    cells = [cell.strip() for cell in total.split("│")[1:-1]]
    assert cells[0] == "all"
    assert int(cells[2]) >= 2  # signals that were sent
    assert int(cells[7]) >= 1  # commands that came to their end
    assert cells[8:] == ["0"] * 6
