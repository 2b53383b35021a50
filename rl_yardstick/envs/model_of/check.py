"""Whether an environment does what a model of it says: 20,000 steps of it, outcome by outcome.

One outcome that the model calls impossible refutes it. So does a frequency that lies six standard
deviations from its expectation: of one outcome of one state and action, or of the first outcomes of
all states and actions together, the second ones, and so on.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.mdp.transition_model import Bools, TransitionModel

STEPS = 20_000
MOST_DEVIATIONS = 6.0
FEWEST = 9.0  # a variance below which counts are far from normally distributed


class Check:
    """Plays an environment at random and compares each step with a model.

    Args:
        env: the environment, which is played as it is.
        model: the model to test.
        state_of: from an observation and the number of steps taken to the number of the state that
            the environment is in; None for a state that the model does not have.
        actions: the environment's actions, in the order of the model.
        mask: actions that are allowed, bool of shape (S, A).
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        model: TransitionModel,
        state_of: Callable[[Any, int], int | None],
        actions: list[Any],
        mask: Bools,
    ) -> None:
        self.env, self.model, self.state_of = env, model, state_of
        self.actions, self.mask = actions, mask
        # Of each state and action: {(next state or -1, reward or None): [probability, count]}.
        self.rows: dict[tuple[int, int], dict[Any, list[float]]] = {}

    def refutation(self, steps: int = STEPS, seed: int = 0) -> str | None:
        """What the environment does that the model does not say, in one line; None if nothing."""
        before = random.getstate(), np.random.get_state()  # noqa: NPY002
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        try:
            return self._impossible(steps, seed) or self._unlikely()
        finally:
            random.setstate(before[0])
            np.random.set_state(before[1])  # noqa: NPY002

    def _impossible(self, steps: int, seed: int) -> str | None:
        rng, state, time = np.random.default_rng(seed), None, 0
        for taken in range(steps):
            if state is None:
                observation, _ = self.env.reset(seed=seed if taken == 0 else None)
                state, time = self.state_of(observation, 0), 0
                if state is None or self.model.initial[state] == 0:
                    return f"the environment starts in a state ({observation}) that is no start"
            action = int(rng.integers(len(self.actions)))
            while not self.mask[state, action]:
                action = int(rng.integers(len(self.actions)))
            observation, reward, *ends = self.env.step(self.actions[action])[:4]
            time += 1
            following = None if ends[0] else self.state_of(observation, time)
            row = self._row(state, action)
            possible = [(following, reward), (following, None)] if following is not None else []
            possible += [(-1, reward), (-1, None)] if any(ends) else []
            key = next((key for key in map(_rounded, possible) if key in row), None)
            if key is None:
                made = "the end" if ends[0] else "such a state" if following is None else following
                step = f"step to {made} with the reward {float(reward):g}, the environment made one"
                return f"state {state}, action {action}: the model has no {step}"
            row[key][1] += 1
            state = None if any(ends) else following
        return None

    def _row(self, state: int, action: int) -> dict[Any, list[float]]:
        at, model = (state, action), self.model
        if at not in self.rows:
            row = self.rows[at] = {}
            for k in np.flatnonzero(model.prob[at] > 0):
                target = -1 if model.terminated[at][k] else int(model.next_state[at][k])
                noise = 0.0 if model.reward_variance is None else model.reward_variance[at][k]
                key = _rounded((target, None if noise > 0 else model.reward[at][k]))
                row.setdefault(key, [0.0, 0.0])[0] += model.prob[at][k]
        return self.rows[at]

    def _unlikely(self) -> str | None:
        """The frequency that the model makes too unlikely."""
        together: dict[int, list[float]] = {}
        for (state, action), row in self.rows.items():
            n = sum(count for _, count in row.values())
            for rank, ((target, _), (p, count)) in enumerate(row.items()):
                off, variance = count - n * p, n * p * (1 - p)
                if abs(off) > MOST_DEVIATIONS * math.sqrt(max(variance, FEWEST)):
                    came = f"has a probability of {p:.3g}, and came {count:.0f} of {n:.0f} times"
                    to = "the end" if target < 0 else target
                    return f"state {state}, action {action}: the step to {to} {came}"
                total = together.setdefault(rank, [0.0, 0.0])
                total[:] = total[0] + off, total[1] + variance
        for off, variance in together.values():
            if abs(off) > MOST_DEVIATIONS * math.sqrt(max(variance, FEWEST)):
                deviations = f"{abs(off) / math.sqrt(variance):.1f} standard deviations"
                return f"outcomes are {deviations} from their probabilities"
        return None


def _rounded(key: tuple[int, Any]) -> tuple[int, float | None]:
    """An outcome with its reward to nine digits."""
    target, reward = key
    return target, None if reward is None else float(f"{float(reward):.9g}")
