"""Agents that are plain classes of the user: trained, compared, played, explained, refused."""

import json
import sys
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from rl_yardstick import agents
from rl_yardstick.agents.own_classes import parameters_of
from rl_yardstick.experiments.pool import process_pool
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models import load, load_agent, model_of_run
from rl_yardstick.pipeline.settings import read_yaml
from tests.pipeline.short_runs import LAKE, cut_off, resumed, run_of, spec_of

MODULE = """
import random
from collections import defaultdict
import numpy as np, torch as th
from stable_baselines3 import DQN
class Base:
    def learn(self, obs, action, reward, next_obs, terminated):
        target = reward + self.gamma * max(self.q[next_obs]) * (not terminated)
        self.q[obs][action] += self.step_size * (target - self.q[obs][action])
    def values(self, obs):
        return self.q[obs]
class Table(Base):
    def __init__(self, n_states, n_actions, seed, step_size=0.5, gamma=0.9, epsilon=1):
        self.q, self.rng = np.zeros((n_states, n_actions)), np.random.default_rng(seed)
        self.step_size, self.gamma, self.epsilon, self.episodes = step_size, gamma, epsilon, 0
    def act(self, obs):
        explores = self.rng.random() < self.epsilon
        return self.rng.integers(len(self.q[obs])) if explores else int(self.q[obs].argmax())
    def reset(self):
        self.episodes += 1
class Lazy(Base):  # no data: rows by a function, and Python's global generator
    step_size, gamma = 0.5, 0.9
    def __init__(self, env):
        self.q, self.env, self.cut = defaultdict(lambda: [0.0] * env.action_space.n), env, 0
    def act(self, obs, explore=True):
        random.random()
        return self.env.action_space.sample() if explore else int(np.argmax(self.q[obs]))
    def learn(self, obs, action, reward, next_obs, terminated, truncated):
        super().learn(obs, action, reward, next_obs, terminated)
        self.cut += truncated
class Net(Base):  # says itself what a zip holds
    step_size, gamma = 0.5, 0.9
    def __init__(self, n_states, n_actions):
        self.q = th.zeros(n_states, n_actions)
    def act(self, obs):
        return int(self.q[obs].argmax()) if th.rand(()) < 0.1 else int(th.randint(4, ()))
    def state_dict(self):
        return {"q": self.q}
    def load_state_dict(self, state):
        self.q = state["q"]
class Begun(Base):  # it can act from its first episode on
    values = None
    def learn(self, *transition): ...
    def reset(self):
        self.action = 1
    def act(self, obs):
        return self.action
class Mine(DQN): ...
class Asked:
    def get_action(self, obs): ...
class Short:
    def act(self, obs): return 0
    def learn(self, obs, action, reward): ...
class Outside(Base):
    def act(self, obs): return 7
class Half(Base):
    def act(self, obs): return 0.0
class Void(Table):
    def values(self, obs): return self.q[obs] + np.nan
class Needs(Table):
    def __init__(self, alpha): ...
class Open(Table):
    def __init__(self, n_states, n_actions, seed):
        super().__init__(n_states, n_actions, seed)
        self.log = open("mine.py")
class Kept(Net):
    def state_dict(self):
        return {"q": self.q, "f": lambda: 0}
class Fails(Table):
    def __init__(self): raise RuntimeError("no table")
class Breaks(Table):
    def learn(self, *transition): self.qq[0] += 1
number = 3
"""
CELL = """
class Cell:
    def act(self, obs): return 1
    def learn(self, obs, action, reward, next_obs, terminated): ...
"""


@pytest.fixture(autouse=True)
def module(own_folder, monkeypatch):
    """The user's module."""
    (own_folder / "mine.py").write_text(MODULE)
    (own_folder / "broken.py").write_text("def act(self obs): ...")
    (own_folder / "broken2.py").write_text("1 / 0")
    monkeypatch.setattr(sys, "path", [*sys.path])


def spec_for(cls, n_timesteps=400, **fields):
    import_modules([typed := f"mine:{cls}"])
    return spec_of(f"mine.{cls}", n_timesteps=n_timesteps, seed=3, gym_packages=[typed], **fields)


def state_of(agent):
    """What it has learnt, and where its generator is."""
    rng, q = getattr(agent, "rng", None), [[*map(float, agent.q[obs])] for obs in range(16)]
    return q, rng and rng.bit_generator.state, getattr(agent, "cut", 0)


def test_it_does_what_a_loop_by_hand_does():
    """Evaluations, which ask it too, change nothing."""
    run, done = run_of(spec_for("Table", 600, eval_freq=50))
    env, cls = gym.make(LAKE), sys.modules["mine"].Table
    agent = cls(env.observation_space.n, env.action_space.n, seed=3)
    (obs, _), rows, rewards = env.reset(seed=3), [], []
    agent.reset()
    for _ in range(600):
        action = agent.act(obs)
        next_obs, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        agent.learn(obs, action, reward, next_obs, terminated)
        obs = next_obs
        if terminated or truncated:
            rows.append([sum(rewards), len(rewards)])
            agent.reset()
            (obs, _), rewards = env.reset(), []
    monitor = pd.read_csv(run.path / "0.monitor.csv", skiprows=1)
    assert monitor[["r", "l"]].to_numpy().tolist() == rows
    assert state_of(done.agent.agent) == state_of(agent)
    assert agent.episodes == done.agent.agent.episodes
    assert done.final.is_exact
    loaded = load_agent(model_of_run(run))
    assert state_of(loaded.agent) == state_of(agent)
    greedy, _ = loaded.predict(np.arange(16), deterministic=True)
    assert greedy.tolist() == agent.q.argmax(axis=1).tolist()


@pytest.mark.usefixtures("states_at_each_moment")
@pytest.mark.parametrize("cls", ["Table", "Lazy", "Net"])
def test_it_goes_on_bit_for_bit_and_its_zip_holds_its_state(cls, monkeypatch):
    spec, form = spec_for(cls, 150), "state_dict" if cls == "Net" else "pickle"
    _, whole = run_of(spec, "whole")
    run = resumed(cut_off(spec, monkeypatch))
    path = run.model_path(spec)
    assert form in json.loads(zipfile.ZipFile(path).read("data"))["state"]["pairs"][0]
    assert state_of(load(spec, path, None).agent) == state_of(whole.agent.agent)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(run.path))  # as on the machine of another user
    if form == "pickle":
        with pytest.raises(UserError, match="holds a pickle, not signed with your key"):
            load(spec, path, None)
    else:
        assert state_of(load(spec, path, None).agent) == state_of(whole.agent.agent)


def test_it_is_judged_as_it_acts_unless_it_says_how_to_act_without_exploring():
    found = {}
    for cls in ("Table", "Lazy", "Net", "Begun"):
        _, done = run_of(spec_for(cls, 60))
        found[cls] = done.final.is_exact
    del sys.modules["mine"].Base.values
    parameters_of.cache_clear()
    _, done = run_of(spec_for("Table", 60))
    is_exact = {"Table": True, "Lazy": False, "Net": True, "Begun": True}
    assert (found, done.final.is_exact) == (is_exact, False)


@pytest.mark.parametrize(("name", "words"), read_yaml(Path(__file__).with_name("no_agents.yml")))
def test_what_is_no_agent_is_refused(typed, own_folder, name, words):
    code, _, err = typed("train.py", "--algo", name, "--env", LAKE, "-n", "20")
    assert code == 2
    assert words in err.splitlines()[0]
    assert ("class MyAgent:\n    def act(self, obs):\n" in err) == (err.count("\n") > 1)
    assert (own_folder / "logs").exists() == (name in ("mine:Outside", "mine:Half", "mine:Void"))


def test_an_error_of_its_constructor_goes_through():
    with pytest.raises(RuntimeError, match="no table"):
        run_of(spec_for("Fails", 20))


def test_an_error_of_its_own_is_told_by_its_lines_and_one_of_ours(typed, own_folder):
    words = "--env", LAKE, "--seed", "1", "-n", "20"
    code, _, err = typed("train.py", "--algo", "mine:Breaks", *words)
    calls, told = err.splitlines()[:-1], err.splitlines()[-1]
    assert (code, [line for line in calls if "File" in line]) == (2, calls[:1])
    assert "mine.py" in calls[0]
    assert told == (
        "train.py: error: mine.Breaks on FrozenLake-v1, seed 1, at step 1: "
        "AttributeError: 'Breaks' object has no attribute 'qq'"
    )
    (record,) = own_folder.glob("logs/*/*/run.json")
    assert json.loads(record.read_text())["state"] == "failed"


def test_commands_take_it(typed, own_folder, in_this_process):
    words = ["--env", LAKE, "-n", "300"]
    algo = ["--algo", "mine:Table"]
    first = [*words, *algo, "--seed", "0", "-params", "epsilon:0.5"]
    assert "--gym-packages mine:Table" in typed.done("train.py", *first)
    run = "logs/mine.Table/FrozenLake-v1_1"
    assert "add --gym-packages mine:Table" in typed("enjoy.py", run)[2]
    played = ["enjoy.py", run, "--n-episodes", "1", "--render", "none"]
    for command in (played, ["yardstick", "explain", run]):
        assert typed(*command, *algo)[::2] == (0, "")
    zipped = ["-i", f"{run}/FrozenLake-v1.zip", "--seed", "1"]
    assert typed("train.py", *words, *algo, *zipped)[::2] == (0, "")
    words += ["--algos", "random", "mine:Table", "mine:Mine", "--seeds", "2", "--no-report"]
    assert "mine.Table                 undecided" in typed.done("compare.py", *words)
    out = typed.done("yardstick", "audit", *algo, "--kind", "q_learning", "--seeds", "1")
    assert out.endswith("0.80 value where cut off\nright\n")


def action_of(name):
    return agents.load_algorithm(name).plain().act(0)


def test_other_processes_get_classes_by_value(own_folder):
    cell = {"__name__": "__main__"}
    exec(CELL, cell)  # noqa: S102  # as a notebook does
    assert agents.name_of(cell["Cell"]) == "Cell"
    with pytest.raises(ValueError, match="there is an agent ppo already"):
        agents.name_of(type("PPO", (cell["Cell"],), {"__module__": "__main__"}))
    pool = process_pool(1)
    assert pool.schedule(action_of, args=["Cell"]).result() == 1
    pool.stop()
    pool.join()
