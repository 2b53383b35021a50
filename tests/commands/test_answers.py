"""What commands answer: by which name, before they load much, and to mistakes, in a line."""

import os
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from rl_yardstick.commands import COMMANDS
from tests.pipeline.short_runs import trained

ROOT = Path(__file__).parents[2]
LAKE = ["--algo", "qlearning", "--env", "FrozenLake-v1"]


def test_training_by_the_installed_name(typed, tmp_path):
    words = [*LAKE, "--seed", "0", "-n", "500"]
    out = typed.done("/venv/bin/yardstick", "train", *words)
    assert "watch    yardstick enjoy logs/qlearning/FrozenLake-v1_1\n" in out
    assert "explain  yardstick explain logs/qlearning/FrozenLake-v1_1\n" in out
    assert "compare  yardstick compare --env FrozenLake-v1 --algos qlearning sarsa" in out
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    written = (run / "FrozenLake-v1" / "command.txt").read_text()
    assert written == f"yardstick train {shlex.join(words)}\n"


def test_its_version(typed):
    assert typed("yardstick", "--version") == (0, f"{version('rl-yardstick')}\n", "")


QUICKLY = ("train --help", "train --list", "compare --help", "enjoy --algo ppo --env CartPole-v1")
QUICKLY += ("train --env CartPole-v1 --algo ppo -params gama:1",)
PROGRAM = """
import sys
from rl_yardstick import commands

class Heavy:
    def find_spec(self, name, path=None, target=None):
        assert name not in ("torch", "numba", "stable_baselines3", "pandas", "scipy", "matplotlib")

sys.meta_path.insert(0, Heavy())
for line in sys.argv[1:]:
    command, *words = line.split()
    sys.argv = [f"yardstick {command}", *words]
    print("ANSWER", commands._exit_code(command), flush=True)
"""


def test_answers_before_anything_heavy_is_loaded(tmp_path):
    words = [sys.executable, "-c", PROGRAM, *QUICKLY]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, check=True)
    codes = [line for line in done.stdout.splitlines() if line.startswith("ANSWER ")]
    assert codes == ["ANSWER 0"] * 3 + ["ANSWER 2"] * 2


TABLE = yaml.safe_load(Path(__file__).with_name("wrong_commands.yml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    run, _ = trained("qlearning", folder=folder, n_timesteps=300)
    trained("linucb", "SegmentBandit-v0", folder=folder, n_timesteps=300)
    (folder / "truncated.zip").write_bytes((run.path / "FrozenLake-v1.zip").read_bytes()[:-200])
    return folder


MISTAKES = [*((line, "") for line in TABLE["commands"]), *TABLE["said"].items()]


@pytest.mark.parametrize(("line", "said"), MISTAKES)
def test_mistakes_are_one_line(line, said, typed, tmp_path, request):
    for name, text in TABLE["files"].items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    if "logs/" in line or line.startswith("enjoy.py --algo qlearning"):
        (tmp_path / "logs").symlink_to(request.getfixturevalue("runs"))
    before = set(tmp_path.rglob("*"))
    code, out, err = typed(*shlex.split(line))
    assert (code, err.count("\n")) == (2, 1), out + err
    assert said in err
    assert "Traceback" not in out + err
    assert set(tmp_path.rglob("*")) == before
    assert len(err) < 1200
    assert not (out and "audit" in line)


def test_no_line_in_a_pipe_is_too_wide(typed, monkeypatch, in_this_process):
    monkeypatch.setenv("COLUMNS", "80")
    for words in [*(f"{command} --help" for command in COMMANDS), *TABLE["right"]]:
        code, out, err = typed("yardstick", *words.split())
        assert code in (0, 1), err
        for line in filter(lambda line: " " in line.strip(), out.splitlines()):
            assert len(line) <= (80 if line[:1] in tuple("┏┃┡│└") else 100), words
