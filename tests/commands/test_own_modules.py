"""train.py, enjoy.py and compare.py on agents and environments of a user's own."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np

from rl_yardstick.agents import ALGORITHMS

AGENTS = """
import gymnasium

from rl_yardstick import agents

agents.register("lazy", f"{__name__}:Lazy", summary="counts [rewards]", actions=("Discrete",))
gymnasium.register("my/Lake-v0", "gymnasium.envs.toy_text:FrozenLakeEnv", max_episode_steps=30)


class Lazy(agents.load_algorithm("random")):
    def __init__(self, policy="RandomPolicy", env=None, weight=0.5, **kwargs):
        super().__init__(policy, env, **kwargs)
        self.weight = weight
"""
ROOT = Path(__file__).parents[2]
LAZY = ["--algo", "lazy", "--env", "my/Lake-v0"]
PLAY = ["--n-episodes", "1", "--render", "none"]


def test_a_run_does_not_have_modules_imported(typed, own_folder, monkeypatch, tmp_path):
    """It says what to type instead, from wherever it is asked."""
    (own_folder / "my_agents.py").write_text(AGENTS)
    out = typed.done("train.py", "--list", "--gym-packages", "./my_agents.py")
    assert any(line.split()[:3] == ["lazy", "counts", "[rewards]"] for line in out.splitlines())
    typed.done("train.py", *LAZY, "--gym-packages", "my_agents", "-n", "40")
    del ALGORITHMS["lazy"], sys.modules["my_agents"], gymnasium.registry["my/Lake-v0"]
    logs = own_folder / "logs"
    run = logs / "lazy" / "my-Lake-v0_1"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    by_name, by_path = [*LAZY, "-f", logs], [run / "my-Lake-v0.zip", "-f", logs]
    for words in (by_name, by_path):
        said = "was made with modules of yours: add --gym-packages my_agents"
        assert said in typed.refused("enjoy.py", *words, *PLAY)
        assert "my_agents" not in sys.modules
    words = ["--gym-packages", own_folder / "my_agents.py"]
    typed.done("enjoy.py", *by_path, *PLAY, *words)


BRIDGE = """
import gymnasium


class Bridge(gymnasium.Env):
    def __init__(self, length=4):
        self.observation_space, self.length = gymnasium.spaces.Discrete(length), length
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = self.steps = 0
        return 0, {}

    def step(self, action):
        self.cell, self.steps = max(self.cell + 2 * int(action) - 1, 0), self.steps + 1
        return self.cell, -1.0, self.cell == self.length - 1, self.steps == 20, {}


def long(length=9):
    return Bridge(length)


gymnasium.register("Short", "bridges:Bridge", kwargs={"length": 3})
"""


def test_every_command_takes_a_class_as_an_environment(typed, own_folder, in_this_process):
    """Also a function that makes one, and an id without a version."""
    (own_folder / "bridges.py").write_text(BRIDGE)
    bridge, run = ["--env", "bridges.py:Bridge"], "logs/qlearning/bridges.Bridge_1"
    out = typed.done("train.py", *bridge, "--algo", "qlearning", "--seed", "0", "-n", "400")
    assert "qlearning on bridges.Bridge, seed 0, 400 steps" in out
    assert "return -3 of -3" in out
    told = " ".join(out.replace("\\\n", "").split())
    assert f"{run} --gym-packages bridges.py:Bridge" in told
    assert "add --gym-packages bridges.py:Bridge" in typed.refused("enjoy.py", run, *PLAY)
    np.save("right.npy", np.ones(4, int))
    assert "return -3" in typed.done("yardstick", "rate", "right.npy", *bridge)
    for words in ([*bridge, "--algo", "qlearning"], [run, *bridge]):
        assert "return -3" in typed.done("enjoy.py", *words, *PLAY)
        assert "it returns -3" in typed.done("yardstick", "explain", *words)
    few = ["-n", "60", "--no-report", "--name", "few"]
    typed.done("compare.py", *bridge, "--algos", "qlearning", "random", "--seeds", "2", *few)
    again = ["--resume", "logs/studies/few", "--gym-packages", "bridges:Bridge", "--no-report"]
    assert "4 of them there already" in typed.done("compare.py", *again)
    few = [*few[:-1], "search", "--trials", "2", "--seeds-per-trial", "1", "--retest", "0"]
    typed.done("tune.py", *bridge, "--algo", "qlearning", *few)
    for name, optimum in (("bridges:long", -8), ("bridges:Short", -2)):
        assert f"optimum   {optimum}\n" in typed.done("yardstick", "optimum", "--env", name)
    assert "bridges.Bridge lacks act" in typed("train.py", "--algo", "bridges:Bridge")[2]


NAMES = ("agents", "envs", "experiments", "pipeline", "mdp", "report", "models")
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}


def test_a_folder_full_of_names_on_a_machine_that_knows_ascii_alone(own_folder):
    """Its modules have the names of our packages."""
    text = AGENTS.replace("counts", "größer als ∞?")
    (own_folder / "my_agents.py").write_text(text, encoding="utf-8")
    for name in NAMES:
        (own_folder / f"{name}.py").write_text("raise SystemExit('a module of the user was taken')")
    words = [sys.executable, ROOT / "train.py", "--list", "--gym-packages", "./my_agents.py"]
    env = {**os.environ, **ASCII}
    done = subprocess.run(words, cwd=own_folder, env=env, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"gr??er als ??" in done.stdout
