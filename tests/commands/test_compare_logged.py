"""compare.py --logged: trained agents judged on logged pulls, as a user types it."""

import json
import re
from functools import partial
from pathlib import Path

import gymnasium as gym
import pytest

import compare
import envs  # noqa: F401
from agents import load_algorithm
from envs.bandits import log_uniformly
from experiments.off_policy.estimators import difference_in_value

RUN = "logs/linucb/ReplayBandit-v0_1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two logs of the same A/B test, and agents trained on the first one."""
    folder = tmp_path_factory.mktemp("logged")
    with gym.make("SegmentBandit-v0") as env:
        for seed, name in enumerate(("first.csv", "second.csv")):
            log_uniformly(env, 1500, seed, folder / name)
    train(folder, "linucb", RUN)
    train(folder, "thompson", "logs/thompson/ReplayBandit-v0_1", ignore_context=True)
    train(folder, "ppo", "logs/ppo/ReplayBandit-v0_1", policy="MlpPolicy", n_steps=64)
    return folder


def train(folder, algo, run, **kwargs):
    """An agent in a run folder such as training leaves behind."""
    env = gym.make("ReplayBandit-v0", log=folder / "first.csv")
    agent = load_algorithm(algo)(env=env, seed=0, **kwargs)
    agent.learn(200 if algo == "ppo" else 1500)
    (folder / run).mkdir(parents=True)
    agent.save(folder / run / "ReplayBandit-v0.zip")
    env.close()
    spec = {"algo": algo, "env_id": "ReplayBandit-v0"}
    spec["hyperparams"] = {"env_kwargs": {"log": "first.csv"}}
    info = {"env_name": "ReplayBandit-v0", "spec": spec}
    (folder / run / "run.json").write_text(json.dumps(info))


@pytest.fixture
def judge(folder, type_command, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "120")  # room for the paths of runs
    return partial(type_command, "compare.py")


def test_the_same_policy_twice_is_told(judge):
    """The table and the verdicts are recorded in ``tests/golden``."""
    code, out, err = judge("--logged", "second.csv", "--policy", RUN, f"{RUN}/ReplayBandit-v0.zip")
    assert (code, err) == (0, "")
    assert "second.csv: 1,500 pulls, 3 arms" in out
    assert re.search(rf"{RUN} against always arm \d: \+0\S+ \[\S+, \S+\] a pull, \w+", out)
    assert f"{RUN} and {RUN}/ReplayBandit-v0.zip do the same on this log" in out


def test_agents_of_the_library_and_blind_ones_are_judged_too(judge, folder, tmp_path):
    runs = ["logs/ppo/ReplayBandit-v0_1", "logs/thompson/ReplayBandit-v0_1"]
    code, out, err = judge("--logged", "first.csv", "--policy", *runs)
    assert (code, err) == (0, "")
    for run in runs:
        assert f"{run} was trained on this log: its figures flatter it" in out
    alone = tmp_path / "alone.zip"
    alone.write_bytes((folder / runs[0] / "ReplayBandit-v0.zip").read_bytes())
    code, _, err = judge("--logged", "second.csv", "--policy", str(alone))
    assert code == 2
    assert "is in no run folder: its agent is not known" in err


def test_the_python_of_the_page_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = Path(compare.__file__).parent / "docs" / "bandits.md"
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
