"""How often `envs.check_transition_model` is wrong: right models refused, wrong ones believed.

    python benchmarks/model_check_errors.py

False alarms: random models, each its environment's very own, of 1 to 30 states, 1 to 4 actions and
up to 5 outcomes, with certain and very unlikely ones among them; in one of twenty the state cannot
be set. The bound is one in a million over all tests of a check. A second row moves it to one in
ten, which a check of 500 steps can come near.

Power: a probability that ``P`` has wrong by so much, either of a single state and action, or of
all at once, as of a wind that blows everywhere; with the steps that a check takes by default.
"""

from __future__ import annotations

import os
import time
from bisect import bisect_right
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.random import Generator

from envs import check_transition_model, checking

N_MODELS = 10_000
STEPS = 500
REPEATS = 10
ERRORS = (0.02, 0.05, 0.1, 0.2, 0.3)
WIND = 0.3

Table = dict[int, dict[int, list[tuple[float, int, float, bool]]]]


class TableEnv(gym.Env[Any, Any]):
    """Does what one table says, tells another, and draws from a generator of its own."""

    def __init__(self, true: Table, told: Table, start: list[float], rng: Generator) -> None:
        self.P, self.initial_state_distrib = told, np.array(start)
        self.observation_space = spaces.Discrete(len(true))
        self.action_space = spaces.Discrete(len(true[0]))
        self.true, self.rng = true, rng
        self.start = np.cumsum(start).tolist()
        self.upto = {
            (s, a): np.cumsum([outcome[0] for outcome in row]).tolist()
            for s, rows in true.items()
            for a, row in rows.items()
        }
        self.s = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        """Begin an episode."""
        self.s = min(bisect_right(self.start, self.rng.random()), len(self.start) - 1)
        return self.s, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Draw an outcome."""
        row = self.true[self.s][action]
        drawn = bisect_right(self.upto[self.s, action], self.rng.random())
        _, self.s, reward, terminated = row[min(drawn, len(row) - 1)]
        return self.s, reward, terminated, False, {}


class SealedEnv(TableEnv):
    """One that goes on from where it was, wherever it is put."""

    place = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        """Begin an episode."""
        self.place, info = super().reset()
        return self.place, info

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Draw an outcome."""
        self.s = self.place
        self.place, reward, terminated, truncated, info = super().step(action)
        return self.place, reward, terminated, truncated, info


def random_table(rng: Generator) -> tuple[Table, list[float]]:
    """A table, and probabilities of starts, of many shapes."""
    n_states, n_actions = int(rng.integers(1, 31)), int(rng.integers(1, 5))
    spread = float(rng.choice([0.05, 0.3, 1.0, 10.0]))
    ends = float(rng.choice([0.0, 0.1, 0.4]))

    def row() -> list[tuple[float, int, float, bool]]:
        n = int(rng.integers(1, 6))
        prob = rng.dirichlet(np.full(n, spread)) if n > 1 else np.ones(1)
        reached, rewards = rng.integers(n_states, size=n), rng.integers(-1, 2, size=n)
        over = rng.random(n) < ends
        return list(
            zip(prob.tolist(), reached.tolist(), map(float, rewards), over.tolist(), strict=True)
        )

    table = {s: {a: row() for a in range(n_actions)} for s in range(n_states)}
    return table, rng.dirichlet(np.full(n_states, spread + 0.2)).tolist()


def false_alarms(n_models: int, bound: float) -> int:
    """How many of so many right models are refused."""
    checking.FALSE_ALARMS = bound
    refused = 0
    for seed in range(n_models):
        rng = np.random.default_rng([seed, 1])
        table, start = random_table(rng)
        kind = SealedEnv if seed % 20 == 0 else TableEnv
        refused += check_transition_model(kind(table, table, start, rng), STEPS).refusal is not None
    return refused


def ring(n_states: int, n_actions: int, wind: float) -> Table:
    """States in a ring: forwards by one more than the action, or, by the wind, back by one."""
    return {
        s: {
            a: [
                (1 - wind, (s + a + 1) % n_states, -1.0, False),
                (wind, (s - 1) % n_states, -1.0, False),
            ]
            for a in range(n_actions)
        }
        for s in range(n_states)
    }


def share_found(n_states: int, n_actions: int, error: float, everywhere: bool) -> float:
    """The share of wrong models that is refused."""
    found = 0
    for seed in range(REPEATS):
        rng = np.random.default_rng([seed, 2])
        true = ring(n_states, n_actions, WIND)
        wrong = ring(n_states, n_actions, WIND + error)
        told = ring(n_states, n_actions, WIND + error if everywhere else WIND)
        told[n_states // 2][0] = wrong[n_states // 2][0]
        start = np.eye(n_states)[0].tolist()
        found += check_transition_model(TableEnv(true, told, start, rng)).refusal is not None
    return found / REPEATS


def main() -> None:
    """Print both tables."""
    for n_models, bound in ((N_MODELS, 1e-6), (N_MODELS // 5, 0.1)):
        started = time.process_time()
        refused = false_alarms(n_models, bound)
        print(
            f"{refused} of {n_models:,} right models refused, at a bound of {bound:g} "
            f"({time.process_time() - started:.0f} s of processor time)",
            flush=True,
        )
    checking.FALSE_ALARMS = 1e-6
    print(f"\nshare of {REPEATS} wrong models refused, by the error of a probability of {WIND}")
    print(f"{'states x actions, wrong in':38}" + "".join(f"{error:>7}" for error in ERRORS))
    for n_states, n_actions in ((5, 2), (500, 4)):
        for everywhere in (False, True):
            started = time.process_time()
            shares = [share_found(n_states, n_actions, error, everywhere) for error in ERRORS]
            seconds = (time.process_time() - started) / len(ERRORS) / REPEATS
            where = f"{n_states} x {n_actions}, {'all' if everywhere else 'one'}"
            cells = "".join(f"{share:7.2f}" for share in shares)
            print(f"{where:38}{cells}   {seconds:.2f} s each", flush=True)


if __name__ == "__main__":
    main()
