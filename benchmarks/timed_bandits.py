"""Bandit agents; pulls a second.

Our agents use the environment with Monitor; the plain loops and MABWiser get rewards drawn by
NumPy, which favours them.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from mabwiser.mab import MAB, LearningPolicy
from stable_baselines3.common.monitor import Monitor

import rl_yardstick.envs  # noqa: F401  # registers the bandits
from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.bandits.runs import run_batch
from timing import Benchmark, Rows, speed

PULLS = 1000
BATCH = 200
N_ARMS, N_FEATURES = 10, 5
PROBABILITIES = (0.2, 0.5, 0.75)
EPSILON, CONFIDENCE = 0.1, 1.0
# Our agents: arguments, environment, its arguments.
OURS: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "epsilon_greedy": ({"exploration_initial_eps": EPSILON}, "GaussianBandit-v0", {}),
    "ucb": ({"c": CONFIDENCE}, "GaussianBandit-v0", {}),
    "thompson": ({}, "BernoulliBandit-v0", {}),
    "linucb": ({}, "LinearBandit-v0", {"n_arms": N_ARMS, "n_features": N_FEATURES}),
}
MABWISER = {
    "epsilon_greedy": LearningPolicy.EpsilonGreedy(EPSILON),
    "ucb": LearningPolicy.UCB1(CONFIDENCE),
    "thompson": LearningPolicy.ThompsonSampling(),
    "linucb": LearningPolicy.LinUCB(1.0),
}


class World:
    """Rewards for a plain loop."""

    def __init__(self, name: str) -> None:
        self.rng = np.random.default_rng(0)
        self.coins = name == "thompson"
        self.n_arms = len(PROBABILITIES) if self.coins else N_ARMS
        self.means = PROBABILITIES if self.coins else self.rng.standard_normal(N_ARMS)
        self.weights = self.rng.standard_normal((N_ARMS, N_FEATURES))

    def pull(self, arm: int, context: Any = None) -> float:
        """A reward of ``arm``, in a context where one is given."""
        if context is not None:
            return float(self.rng.normal(self.weights[arm] @ context))
        if self.coins:
            return float(self.rng.random() < self.means[arm])
        return float(self.rng.normal(self.means[arm]))


def batch(name: str) -> None:
    """Our compiled batch."""
    kwargs, env_id, env_kwargs = OURS[name]
    run_batch(name, kwargs, env_id, env_kwargs, range(BATCH))


def interpreted(name: str) -> None:
    """Our agent, step by step."""
    kwargs, env_id, env_kwargs = OURS[name]
    env = Monitor(gym.make(env_id, **env_kwargs))
    agent: Any = load_algorithm(name)(env=env, seed=0, **kwargs)
    agent.learn(PULLS, log_interval=None)


def plain(name: str) -> None:
    """A loop as written by hand, with NumPy."""
    world = World(name)
    rng, n_arms = world.rng, world.n_arms
    values, counts, wins = np.zeros(n_arms), np.zeros(n_arms), np.zeros(n_arms)
    for t in range(PULLS):
        if name == "thompson":
            arm = int(np.argmax(rng.beta(1 + wins, 1 + counts - wins)))
        elif name == "ucb" and t >= n_arms:
            arm = int(np.argmax(values + CONFIDENCE * np.sqrt(2 * math.log(t) / counts)))
        elif name == "ucb":
            arm = t
        else:
            explores = rng.random() < EPSILON
            arm = int(rng.integers(n_arms)) if explores else int(np.argmax(values))
        reward = world.pull(arm)
        counts[arm] += 1
        wins[arm] += reward
        values[arm] += (reward - values[arm]) / counts[arm]


def plain_linucb() -> None:
    """LinUCB as written by hand, with the inverse updated by Sherman and Morrison's formula."""
    world = World("linucb")
    inverses = np.tile(np.eye(N_FEATURES), (N_ARMS, 1, 1))
    moments = np.zeros((N_ARMS, N_FEATURES))
    for _ in range(PULLS):
        x = world.rng.uniform(-1, 1, N_FEATURES)
        half = inverses @ x
        means = np.einsum("ad,ad->a", half, moments)
        arm = int(np.argmax(means + np.sqrt(half @ x)))
        reward = world.pull(arm, x)
        inverses[arm] -= np.outer(half[arm], half[arm]) / (1 + half[arm] @ x)
        moments[arm] += reward * x


def mabwiser(name: str) -> None:
    """MABWiser, one decision and one reward at a time."""
    world = World(name)
    arms = list(range(world.n_arms))
    mab = MAB(arms, MABWISER[name])
    if name != "linucb":
        mab.fit(arms, [world.pull(arm) for arm in arms])
        for _ in range(PULLS):
            arm = mab.predict()
            mab.partial_fit([arm], [world.pull(arm)])
        return
    mab.fit([0], [0.0], world.rng.uniform(-1, 1, N_FEATURES)[None])
    for _ in range(PULLS):
        x = world.rng.uniform(-1, 1, N_FEATURES)[None]
        arm = mab.predict(x)
        mab.partial_fit([arm], [world.pull(arm, x[0])], x)


def rows(folder: Path) -> Rows:
    """A plain loop, MABWiser, and ours one by one and as a batch of 200 runs."""
    made: Rows = {}
    for name in OURS:
        batch(name)  # compiled by now
        loop = plain_linucb if name == "linucb" else partial(plain, name)
        made[name] = {
            "NumPy loop": speed(loop, PULLS),
            "MABWiser": speed(partial(mabwiser, name), PULLS),
            "our agent": speed(partial(interpreted, name), PULLS),
            "our batch": speed(partial(batch, name), BATCH * PULLS),
        }
    return made


BENCHMARK = Benchmark("pulls a second", rounds=5, rows=rows)
