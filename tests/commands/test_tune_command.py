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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--env", "FrozenLake-v1", "--algo", "qlerning"], "did you mean 'qlearning'?"),
        ([*WORDS[:4], "--search-space", "none.yml"], "--search-space: there is no file none.yml"),
        ([*WORDS[:4], "--first-seed", "998"], "seed 1000 is one of the search and of the re-test"),
        ([*WORDS[:4], "--storage", "redis://u:secret@h"], "--storage: 'redis://u:***@h' is no"),
        ([*WORDS[:4], "-params", "gama:0.9"], "did you mean 'gamma'?"),
        ([*WORDS[:4], "-n", "9", "--n-episodes", "9"], "give -n or --n-episodes, not both"),
        ([*WORDS[:6], "--sampler", "grid", "--trials", "3"], "give more trials"),
        ([*WORDS[:6], "--storage", "."], "--storage journal:FILE: . is no file"),
        ([*WORDS[:4], "--search-space", "odd.yml"], "'maxx_episode_steps': did you mean"),
        ([*WORDS[:4], "--n-evaluations", "3"], "--eval-freq"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(folder, type_command, words, message):
    Path("odd.yml").write_text("default: {train_env_kwargs.maxx_episode_steps: [5, 50]}")
    code, _, err = type_command(*words)
    assert code == 2
    assert len(err.splitlines()) == 1
    assert message in err
    assert "secret" not in err
    assert not Path("logs").exists()


def test_what_it_takes_is_named_where_it_is_not_installed(folder, type_command, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert (
        type_command(*WORDS)[2]
        == "tune.py: error: tuning needs: pip install 'rl-yardstick[tune]'\n"
    )


def test_flags_of_the_library_for_a_search_point_here(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train.py", "-optimize", "--n-trials", "100"])
    with pytest.raises(SystemExit):
        run_command(train.main)
    assert "by the command tune: see tune --help" in capsys.readouterr().err
