"""compare.py --logged: trained agents judged on logged pulls, as a user types it."""

import re
import shutil
from pathlib import Path

import gymnasium as gym
import pytest

import rl_yardstick.envs  # noqa: F401
from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs.bandits import log_uniformly
from rl_yardstick.experiments.off_policy import difference_in_value
from rl_yardstick.pipeline.run import FINISHED, Run
from rl_yardstick.pipeline.spec import TrainSpec


def train(folder, algo, run, **kwargs):
    """An agent in a run folder such as training leaves behind."""
    env = gym.make("ReplayBandit-v0", log=folder / "log.csv")
    agent = load_algorithm(algo)(env=env, seed=0, **kwargs)
    agent.learn(200 if algo == "ppo" else 1500)
    (folder / run).mkdir(parents=True)
    agent.save(folder / run / "ReplayBandit-v0.zip")
    env.close()
    fields = {"algo": algo, "env_id": "ReplayBandit-v0", "env_kwargs": {"log": "log.csv"}}
    Run(folder / run).record(TrainSpec(n_timesteps=1, **fields), FINISHED)


def test_agents_of_the_library_and_blind_ones_are_judged(type_command, tmp_path, monkeypatch):
    """The table and the verdicts of another agent are recorded in ``tests/golden``."""
    monkeypatch.setenv("COLUMNS", "120")  # room for the paths of runs
    with gym.make("SegmentBandit-v0") as env:
        log_uniformly(env, 1500, 0, tmp_path / "log.csv")
    blind, ppo = "logs/thompson/ReplayBandit-v0_1", "logs/ppo/ReplayBandit-v0_1"
    train(tmp_path, "thompson", blind, ignore_context=True)
    train(tmp_path, "ppo", ppo, policy="MlpPolicy", n_steps=64)
    code, out, err = type_command("compare.py", "--logged", "log.csv", "--policy", blind, ppo)
    assert (code, err) == (0, "")
    for run in (blind, ppo):
        assert f"{run} was trained on this log: its figures flatter it" in out
    shutil.copy(tmp_path / ppo / "ReplayBandit-v0.zip", "alone.zip")
    code, _, err = type_command("compare.py", "--logged", "log.csv", "--policy", "alone.zip")
    assert code == 2
    assert "is in no run folder" in err


def test_the_python_of_the_page_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = Path(__file__).parents[2] / "docs" / "bandits.md"
    draw, decide = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    names = {}
    exec(draw, names)  # noqa: S102
    exec(decide, names)  # noqa: S102
    names["env"].close()
    printed = capsys.readouterr().out
    # What the page quotes: +0.036 [+0.016, +0.056] against arm 1.
    assert printed.startswith("always arm 1 Estimate(point=0.036")
    estimate = difference_in_value(names["linucb"].terms, names["best"].terms, n_comparisons=4)
    assert (estimate.low, estimate.high) == pytest.approx((0.016, 0.056), abs=6e-4)
