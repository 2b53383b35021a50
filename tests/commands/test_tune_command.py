"""tune.py as a user types it: what is run, what survives a kill, and what is written down."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import train
import tune
from commands.cli import run_command

ROOT = Path(train.__file__).parent
SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""
WORDS = ["--env", "FrozenLake-v1", "--algo", "qlearning", "--search-space", "space.yml"]
WORDS += ["--n-episodes", "40", "--seeds-per-trial", "2", "--retest-seeds", "2", "--retest", "1"]
WORDS += ["--n-startup-trials", "3", "-j", "1", "--no-report", "--storage", "journal:trials.log"]
FOLDER = Path("logs/tuning/FrozenLake-v1_qlearning")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "space.yml").write_text(SPACE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def type_command(folder, monkeypatch, capfd):
    """Run a command line in this process, inside a folder of its own."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["tune.py", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            run_command(tune.main)
        captured = capfd.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


def start(*words):
    return subprocess.Popen(
        [sys.executable, str(ROOT / "tune.py"), *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def finished_runs():
    return sorted(FOLDER.glob("runs/*/*/run.json"))


def test_a_driver_that_is_killed_and_started_again_beside_another_makes_one_study(
    folder, type_command
):
    words = [*WORDS, "--trials", "5"]
    killed = start(*words)
    while len(finished_runs()) < 3:
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.01)
    killed.kill()
    killed.communicate()
    before = {path: path.stat().st_mtime_ns for path in finished_runs()}
    other = start(*words)
    code, out, err = type_command(*words)
    said, _ = other.communicate(timeout=120)
    assert other.returncode == 0, said
    assert (code, err) == (0, "")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    record = json.loads((FOLDER / "tuning.json").read_text())
    assert [trial["number"] for trial in record["trials"]] == list(range(5))
    assert {trial["state"] for trial in record["trials"]} <= {"complete", "pruned"}
    assert len({json.dumps(trial["params"]) for trial in record["trials"]}) == 5
    assert "5 trials: " in out


def test_the_same_command_again_does_nothing_and_says_the_same(folder, type_command):
    words = [*WORDS, "--trials", "3", "--pruner", "none"]
    code, out, err = type_command(*words)
    assert (code, err) == (0, "")
    record = (FOLDER / "tuning.json").read_text()
    assert type_command(*words)[0] == 0
    assert (FOLDER / "tuning.json").read_text() == record
    found = json.loads(record)["retest"]
    shipped, other = found["settings"]
    best = max(json.loads(record)["trials"], key=lambda trial: trial["value"] or -9.0)
    of_best = next(each for each in found["settings"] if each["number"] == best["number"])
    assert found["optimism"] == of_best["in_search"] - of_best["held_out"]
    is_better = other["held_out"] > shipped["held_out"]
    assert (found["winner"] is not None) == is_better == (FOLDER / "winner.yml").exists()
    assert ("winner: trial" in out) == is_better
    assert "1 of 3 trials" not in out
