"""What commands answer at once, since they load nothing heavy for it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import train

# Those of help first: what an earlier answer has loaded is there for the later ones.
ANSWERS = [
    *(("yardstick", words, 0) for words in ("--help", "train --help", "enjoy --help")),
    ("yardstick", "compare --help", 0),
    *((program, "--help", 0) for program in ("train", "enjoy", "compare")),
    ("train", "--list", 0),
    ("train", "--nonsense", 2),
    ("train", "--env Warehose-v0", 2),
    ("train", "--algo pppo", 2),
    ("train", "--conf-file missing.yml", 2),
    ("enjoy", "missing.zip", 2),
    ("enjoy", "--algo ppo --env CartPole-v1", 2),
    ("compare", "--nonsense", 2),
    ("compare", "missing.yml", 2),
    ("compare", "--env Taxy-v4 --algos dqn", 2),
    ("compare", "--env Taxi-v4 --algos dqnn", 2),
    ("compare", "--env MountainCarContinuous-v0 --algos sarsa", 2),
]
HEAVY = ("torch", "numba", "stable_baselines3", "pandas", "scipy", "matplotlib")
PROGRAM = """
import json, sys
import commands, compare, enjoy, train
from commands.cli import run_command

MAINS = {"yardstick": commands.main, "train": train.main, "enjoy": enjoy.main}
MAINS["compare"] = compare.main
asked, watched = json.loads(sys.argv[1])
for name, words, _ in asked:
    sys.argv, code = [f"{name}.py".replace("yardstick.py", "yardstick"), *words.split()], 0
    try:
        MAINS[name]() if name == "yardstick" else run_command(MAINS[name])
    except SystemExit as stop:
        code = stop.code
    print("ANSWER", json.dumps([name, words, code, [n for n in watched if n in sys.modules]]))
"""


def test_answers_without_loading_anything_heavy(tmp_path):
    asked = json.dumps([ANSWERS, [*HEAVY, "gymnasium"]])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, asked],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(Path(train.__file__).parent)},
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("ANSWER ")]
    found = [json.loads(line.removeprefix("ANSWER ")) for line in lines]
    assert [tuple(each[:3]) for each in found] == ANSWERS
    for name, words, _, loaded in found:
        assert set(loaded) <= ({"gymnasium"} if "--help" not in words else set()), (name, words)
