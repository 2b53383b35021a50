"""What is said before the libraries are loaded, and in which order things are announced."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import compare
import enjoy
import train
from commands.cli import run_command
from pipeline.signs_of_life import Activity

ROOT = Path(train.__file__).parent
LAKE = ["--env", "FrozenLake-v1"]
COMMANDS = {"train": train.main, "enjoy": enjoy.main, "compare": compare.main}

# Ends at the first import of a library that takes long.
PROGRAM = """
import sys
class Enough(BaseException):
    pass
class Heavy:
    def find_spec(self, name, path=None, target=None):
        if name in {"torch", "numba", "pandas", "scipy", "matplotlib", "stable_baselines3"}:
            print("THEN", name)
            sys.stdout.flush()
            raise Enough
sys.meta_path.insert(0, Heavy())
from commands.cli import run_command
import COMMAND
try:
    run_command(COMMAND.main)
except Enough:
    pass
"""


def said_before_libraries(folder, command, *words):
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("COMMAND", command), *map(str, words)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert result.stderr == ""
    before, then, _ = result.stdout.partition("THEN")
    assert then
    return before


@pytest.fixture
def announced(monkeypatch, tmp_path):
    """Run a command line in this process; what it said that it was doing."""
    monkeypatch.chdir(tmp_path)
    texts = []
    now = Activity.now

    def note(activity, text):
        texts.append(text)
        now(activity, text)

    monkeypatch.setattr(Activity, "now", note)

    def run(command, *words):
        texts.clear()
        monkeypatch.setattr(sys, "argv", [f"{command}.py", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            run_command(COMMANDS[command])
        assert stop.value.code == 0
        return list(texts)

    return run


def test_training_and_playing_begin_with_what_they_are_about(announced, tmp_path):
    words = ["--algo", "qlearning", *LAKE, "--seed", "0", "-n", "500"]
    said = said_before_libraries(tmp_path, "train", *words)
    assert said.startswith("qlearning on FrozenLake-v1, seed 0, 500 steps\n")
    assert said_before_libraries(tmp_path, "train", *words, "--verbose", "0") == ""
    assert list(tmp_path.iterdir()) == []
    assert announced("train", *words) == [
        "loading the libraries",
        "making the environments and the agent",
        "saving what was learnt",
        "evaluating the final policy",
        "drawing the pictures",
    ]
    model = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1" / "FrozenLake-v1.zip"
    said = said_before_libraries(tmp_path, "enjoy", model)
    assert said == f"qlearning on FrozenLake-v1: {model}\n"
    film = tmp_path / "film.gif"
    assert announced("enjoy", model, "--n-episodes", "1", "--record", film) == [
        "loading the libraries",
        "loading the agent",
        "playing",
        "writing the film",
        "working out what the policy is worth",
    ]


def test_a_study_begins_with_its_title_and_goes_on_unread(announced, left_by_its_reader, tmp_path):
    words = [*LAKE, "--algos", "qlearning", "--seeds", "1", "-n", "500", "--name", "s"]
    title = "qlearning on FrozenLake-v1\n"
    begun = "1 runs, 0 of them there already; 2 at once, in logs/studies/s\n"
    assert said_before_libraries(tmp_path, "compare", *words, "-j", 2) == title + begun
    found = left_by_its_reader(tmp_path, "compare.py", *words, "--no-report")
    assert found == (title, "", 0)
    summary = tmp_path / "logs" / "studies" / "s" / "summary.csv"
    assert summary.read_text().count("\n") == 2
    # The runs are there; what is left is said in its order.
    assert announced("compare", *words) == [
        "looking for runs that are there",
        "loading the libraries",
        "reading the results",
        "judging the agents",
        "looking at runs that failed",
        "writing the tables",
        "working out the curves",
        "drawing the figures",
        "writing the page",
    ]
