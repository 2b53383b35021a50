"""Speed of bandit agents: processor time per pull, one after the other in each of several rounds.

    python benchmarks/bandit_speed.py                  # five rounds: about a minute
    python benchmarks/bandit_speed.py --rounds 1

Epsilon-greedy and UCB on the ten-armed testbed, Thompson sampling on three coins, LinUCB on linear
rewards. Our engines go through the environment, Monitor and all; the plain loops, MABWiser and
river are handed rewards that NumPy draws, which favours them. Reported are medians over the rounds
and how many times as long as our batch the others take. At the end, the ten-armed testbed: 2000
runs of 1000 pulls of six agents.

MABWiser comes with the extra ``bandits``; river is no dependency of this project and is left out
where it is not installed.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import math
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.monitor import Monitor

import envs  # noqa: F401  # registers the bandits
from agents import load_algorithm
from agents.bandits.runs import run_batch

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
TESTBED: list[tuple[str, dict[str, Any], float]] = [
    ("epsilon_greedy", {"exploration_initial_eps": 0.0}, 0.0),
    ("epsilon_greedy", {"exploration_initial_eps": 0.01}, 0.0),
    ("epsilon_greedy", {"exploration_initial_eps": 0.1}, 0.0),
    ("ucb", {"variant": "sutton_barto", "c": 2.0}, 0.0),
    ("gradient_bandit", {"learning_rate": 0.1}, 4.0),
    ("gradient_bandit", {"learning_rate": 0.1, "baseline": False}, 4.0),
]

# Does some pulls, and returns how many.
Contender = Callable[[], int]


def batch(name: str) -> int:
    """Our compiled batch."""
    kwargs, env_id, env_kwargs = OURS[name]
    run_batch(name, kwargs, env_id, env_kwargs, range(BATCH))
    return BATCH * PULLS


def interpreted(name: str) -> int:
    """Our agent, step by step."""
    kwargs, env_id, env_kwargs = OURS[name]
    env = Monitor(gym.make(env_id, **env_kwargs))
    agent: Any = load_algorithm(name)(env=env, seed=0, **kwargs)
    agent.learn(PULLS, log_interval=None)
    env.close()
    return PULLS


class World:
    """Rewards as a plain loop draws them."""

    def __init__(self, name: str) -> None:
        self.rng = np.random.default_rng(0)
        self.coins = name == "thompson"
        self.n_arms = len(PROBABILITIES) if self.coins else N_ARMS
        self.means = PROBABILITIES if self.coins else self.rng.standard_normal(N_ARMS)
        self.weights = self.rng.standard_normal((N_ARMS, N_FEATURES))

    def pull(self, arm: int) -> float:
        """A reward of ``arm``."""
        if self.coins:
            return float(self.rng.random() < self.means[arm])
        return float(self.rng.normal(self.means[arm]))

    def context(self) -> Any:
        """Features to choose in."""
        return self.rng.uniform(-1, 1, N_FEATURES)

    def pull_in(self, arm: int, context: Any) -> float:
        """A reward of ``arm`` in ``context``."""
        return float(self.rng.normal(self.weights[arm] @ context))


def plain(name: str) -> int:
    """As written by hand, with NumPy."""
    if name == "linucb":
        return plain_linucb()
    world = World(name)
    rng, n_arms = world.rng, world.n_arms
    values, counts, wins = np.zeros(n_arms), np.zeros(n_arms), np.zeros(n_arms)
    for t in range(PULLS):
        if name == "thompson":
            arm = int(np.argmax(rng.beta(1 + wins, 1 + counts - wins)))
        elif name == "ucb" and t >= n_arms:
            bonus = CONFIDENCE * np.sqrt(2 * math.log(t) / counts)
            arm = int(np.argmax(values + bonus))
        elif name == "ucb":
            arm = t
        elif rng.random() < EPSILON:
            arm = int(rng.integers(n_arms))
        else:
            arm = int(np.argmax(values))
        reward = world.pull(arm)
        counts[arm] += 1
        wins[arm] += reward
        values[arm] += (reward - values[arm]) / counts[arm]
    return PULLS


def plain_linucb() -> int:
    """With the inverse kept by the formula of Sherman and Morrison."""
    world = World("linucb")
    inverses = np.tile(np.eye(N_FEATURES), (N_ARMS, 1, 1))
    moments = np.zeros((N_ARMS, N_FEATURES))
    for _ in range(PULLS):
        x = world.context()
        half = inverses @ x
        means = np.einsum("ad,ad->a", half, moments)
        arm = int(np.argmax(means + np.sqrt(half @ x)))
        reward = world.pull_in(arm, x)
        inverses[arm] -= np.outer(half[arm], half[arm]) / (1 + half[arm] @ x)
        moments[arm] += reward * x
    return PULLS


def mabwiser(name: str) -> int:
    """MABWiser, one decision and one reward at a time."""
    from mabwiser.mab import MAB, LearningPolicy

    policies = {
        "epsilon_greedy": LearningPolicy.EpsilonGreedy(EPSILON),
        "ucb": LearningPolicy.UCB1(CONFIDENCE),
        "thompson": LearningPolicy.ThompsonSampling(),
        "linucb": LearningPolicy.LinUCB(1.0),
    }
    world = World(name)
    mab = MAB(list(range(world.n_arms)), policies[name])
    if name == "linucb":
        x = world.context()[None]
        mab.fit([0], [0.0], x)
        for _ in range(PULLS):
            x = world.context()[None]
            arm = mab.predict(x)
            mab.partial_fit([arm], [world.pull_in(arm, x[0])], x)
        return PULLS
    arms = list(range(world.n_arms))
    mab.fit(arms, [world.pull(arm) for arm in arms])
    for _ in range(PULLS):
        arm = mab.predict()
        mab.partial_fit([arm], [world.pull(arm)])
    return PULLS


def river(name: str) -> int:
    """River, one decision and one reward at a time."""
    bandit, proba, stats = (
        importlib.import_module(f"river.{part}") for part in ("bandit", "proba", "stats")
    )

    world = World(name)
    arms = range(world.n_arms)
    if name == "linucb":
        linear = bandit.LinUCBDisjoint(alpha=1.0, seed=0)
        for _ in range(PULLS):
            x = world.context()
            context = dict(enumerate(x.tolist()))
            arm = linear.pull(list(arms), context=context)
            linear.update(arm, context, world.pull_in(arm, x))
        return PULLS
    policies = {
        "epsilon_greedy": bandit.EpsilonGreedy(EPSILON, reward_obj=stats.Mean(), seed=0),
        "ucb": bandit.UCB(delta=CONFIDENCE, reward_obj=stats.Mean(), seed=0),
        "thompson": bandit.ThompsonSampling(reward_obj=proba.Beta(), seed=0),
    }
    policy = policies[name]
    for _ in range(PULLS):
        arm = policy.pull(list(arms))
        policy.update(arm, world.pull(arm))
    return PULLS


CONTENDERS = {
    "our batch": batch,
    "our agent, interpreted": interpreted,
    "plain loop with NumPy": plain,
    "MABWiser": mabwiser,
    "river": river,
}


def present() -> dict[tuple[str, str], Contender]:
    """All that can be timed here, each compiled and imported by a first call."""
    made: dict[tuple[str, str], Contender] = {}
    for work, function in CONTENDERS.items():
        if work.lower() in ("mabwiser", "river") and not importlib.util.find_spec(work.lower()):
            print(f"{work} is not installed: left out")
            continue
        for name in OURS:
            contender = partial(function, name)
            contender()
            made[name, work] = contender
    return made


def nanoseconds(contender: Contender) -> float:
    """Processor time of one pull."""
    started = time.process_time()
    pulls = contender()
    return (time.process_time() - started) / pulls * 1e9


def report(times: dict[tuple[str, str], float]) -> Table:
    """The table of all medians, with ratios to our batch."""
    table = Table("agent", "work", "ns per pull", "times our batch's")
    for name in OURS:
        ours = times[name, "our batch"]
        for (agent, work), took in times.items():
            if agent == name:
                table.add_row(agent, work, f"{took:,.0f}", f"{took / ours:,.1f}")
    return table


def testbed() -> tuple[float, float]:
    """Seconds of wall time and of processor time for the ten-armed testbed."""
    wall, processor = time.perf_counter(), time.process_time()
    for name, kwargs, mean_loc in TESTBED:
        run_batch(name, kwargs, "GaussianBandit-v0", {"mean_loc": mean_loc}, range(2000))
    return time.perf_counter() - wall, time.process_time() - processor


def main() -> None:
    """Time everything and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="rounds (default 5)")
    args = parser.parse_args()
    made = present()
    rounds = [{key: nanoseconds(work) for key, work in made.items()} for _ in range(args.rounds)]
    times = {key: statistics.median(each[key] for each in rounds) for key in made}
    Console(width=100).print(report(times))
    wall, processor = testbed()
    per_pull = processor / (len(TESTBED) * 2000 * PULLS) * 1e9
    print(f"Ten-armed testbed, six agents, 2000 runs of {PULLS} pulls, on one core:")
    print(f"{wall:.1f} s, {processor:.1f} s of them of the processor: {per_pull:.0f} ns a pull")


if __name__ == "__main__":
    main()
