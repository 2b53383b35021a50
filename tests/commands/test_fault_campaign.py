"""A sample of the campaign of random kills: nothing differs, and nothing is left."""

import os
import subprocess
import sys
from pathlib import Path

import compare

ROOT = Path(compare.__file__).parent
COMMANDS = ["qlearning on Warehouse-v0"]  # networks take several times as long


def test_killed_trainings_end_as_they_would_have(tmp_path):
    script = ROOT / "benchmarks" / "fault_campaign.py"
    words = ["--kills", "2", "--jobs", "2", "--only", *COMMANDS]
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
    assert int(cells[7]) >= len(COMMANDS)  # commands that came to their end
    assert cells[8:] == ["0"] * 6
