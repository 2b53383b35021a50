"""Specs, agents, an environment and short runs, as most tests want them; tables of what is said."""

import itertools
import signal
from pathlib import Path

import gymnasium as gym
import pytest

from rl_yardstick.agents import load_algorithm
from rl_yardstick.pipeline.callbacks import StateCallback
from rl_yardstick.pipeline.errors import Stopped
from rl_yardstick.pipeline.run import Run, resumable
from rl_yardstick.pipeline.settings import read_spec, read_yaml
from rl_yardstick.pipeline.training import train

LAKE, CART, SWING, WAREHOUSE = "FrozenLake-v1", "CartPole-v1", "Pendulum-v1", "Warehouse-v0"
TABLES = read_yaml(Path(__file__).with_name("settings.yml"))


class Steady(gym.Env):
    """Episodes of one length, with the returns that are given, again and again."""

    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, returns, length=1):
        self.returns, self.length = itertools.cycle(returns), length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.worth = 0, next(self.returns)
        return 0, {}

    def step(self, action):
        self.steps += 1
        ends = self.steps == self.length
        return 0, self.worth * ends, ends, False, {}


def spec_of(algo, env_id=LAKE, entry=None, *, n_timesteps=1, seed=0, **fields):
    """Of a run that draws nothing."""
    entry = entry or {}
    budget = {} if "n_episodes" in entry else {"n_timesteps": n_timesteps}
    fields = {"pictures": False, "device": "cpu", **fields}
    return read_spec(algo, env_id, {**budget, **entry}, seed=seed, **fields)


def run_of(spec, folder="logs", **fields):
    """A new run folder of a spec, and the outcome of its training."""
    run = Run.claim(Path(folder), spec, **fields)
    with run:
        run.begin(spec, {"seed": spec.seed}, "train.py")
        return run, train(spec, run)


def trained(algo, env_id=LAKE, entry=None, *, folder="logs", **fields):
    """A finished run: its folder, and the outcome."""
    return run_of(spec_of(algo, env_id, entry, **fields), folder)


def cut_off(spec, monkeypatch, share=0.4, run=None):
    """A new run, or one that is resumed, stopped after a share of its steps or episodes."""
    save, stopped = StateCallback._on_rollout_start, []

    def until(self):
        done = self.model.num_timesteps / (spec.n_timesteps or 150)
        if not self.resumes and done >= share:
            self.run.stop.number = signal.SIGTERM
            stopped.append(self.run)
        save(self)

    with monkeypatch.context() as patch:
        patch.setattr(StateCallback, "_on_rollout_start", until)
        with pytest.raises(Stopped):
            resumed(run) if run else run_of(spec, "parts")
    run = Run(stopped[0].path)
    assert run.recorded()["state"] == "interrupted"
    assert run.state_path.exists()
    return run


def resumed(run):
    """The run, whose training goes on in new objects."""
    again = Run(run.path)
    with again:
        train(resumable(run.path), again, resumes=True)
    return again


def agent_of(name, env, **arguments):
    """An agent that has learnt nothing, by its usual policy."""
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env, **{"seed": 0, **arguments})
