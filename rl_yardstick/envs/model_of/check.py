"""Whether an environment does what a model of it says: 20,000 steps of it, outcome by outcome.

One outcome that the model calls impossible refutes it. So does a frequency that lies six standard
deviations from its expectation: of one start, of one outcome of one state and action, or of the
first outcomes of all states and actions together, the second ones, and so on.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.mdp.transition_model import Bools, TransitionModel

STEPS, STEPS_PER_START = 20_000, 40
MOST_DEVIATIONS = 6.0
LEGAL = 0.95  # share of steps for which an action is chosen that is allowed
FEWEST = 9.0  # a variance below which counts are far from normally distributed

NO_START = "the environment starts in a state ({}) that is no start"
START = (-1, 0)  # the place of `reset` among states and actions
# Of each state and action: {(next state, -1 at the end; reward, None if random): [chance, count]}.
Counts = dict[tuple[int, int], dict[Any, list[float]]]


@contextmanager
def seeded_globally(seed: int) -> Iterator[None]:
    """Seed the global generators, and give them back as they were."""
    before = random.getstate(), np.random.get_state()  # noqa: NPY002
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002


def refutation(
    env: gym.Env[Any, Any],
    model: TransitionModel,
    state_of: Callable[[Any, int], int | None],
    actions: list[Any],
    mask: Bools | None = None,
    steps: int = STEPS,
    seed: int = 0,
) -> str | None:
    """What an environment does that a model of it does not say, in one line; None if nothing.

    Args:
        env: the environment, which is played at random as it is.
        model: the model to test.
        state_of: from an observation and the number of steps taken to the number of the state that
            the environment is in; None for a state that the model does not have.
        actions: the environment's actions, in the order of the model.
        mask: actions that are allowed, bool of shape (S, A); None for all.
        steps: how many steps to play.
        seed: of the environment, the actions and the global generators, which are restored.
    """
    with seeded_globally(seed):
        return _refutation(env, model, state_of, actions, mask, steps, seed)


def _refutation(
    env: gym.Env[Any, Any],
    model: TransitionModel,
    state_of: Callable[[Any, int], int | None],
    actions: list[Any],
    mask: Bools | None,
    steps: int,
    seed: int,
) -> str | None:
    rng, time, starts = np.random.default_rng(seed), 0, model.initial
    state: int | None = None
    begun: dict[Any, list[float]] = {
        (s, 0.0): [starts[s], 0] for s in np.flatnonzero(starts).tolist()
    }
    counts: Counts = {START: begun}
    for taken, drawn in enumerate(rng.integers(len(actions), size=steps).tolist()):
        if state is None:
            observation, _ = env.reset(seed=seed if taken == 0 else None)
            state, time = state_of(observation, 0), 0
            if state is None or starts[state] == 0:
                return NO_START.format(observation)
        action = drawn
        if mask is not None and rng.random() < LEGAL:
            action = int(rng.choice(np.flatnonzero(mask[state])))
        at = f"state {state}, action {action}"
        if mask is not None and not mask[state, action]:
            try:
                env.step(actions[action])
            except Exception:  # noqa: BLE001 (as the model says)
                state = None
                continue
            return f"{at}: the environment allows it"
        result, time = env.step(actions[action]), time + 1
        following = None if result[2] else state_of(result[0], time)
        if not _count(model, (state, action), following, result, counts):
            made = "the end" if result[2] else "such a state" if following is None else following
            step = f"step to {made} with the reward {float(result[1]):g}"
            return f"{at}: the model has no {step}, the environment made one"
        state = None if result[2] or result[3] else following
    for _ in range(steps // STEPS_PER_START if len(begun) > 1 else 0):
        observation, _ = env.reset()
        if (first := (state_of(observation, 0), 0.0)) not in begun:
            return NO_START.format(observation)
        begun[first][1] += 1
    return _unlikely(counts)


def _count(
    model: TransitionModel, at: tuple[int, int], following: int | None, result: Any, counts: Counts
) -> bool:
    """Count the outcome of a step; False if the model does not have it."""
    if at not in counts:
        row = counts[at] = {}
        for k in np.flatnonzero(model.prob[at] > 0):
            target = -1 if model.terminated[at][k] else int(model.next_state[at][k])
            noise = 0.0 if model.reward_variance is None else model.reward_variance[at][k]
            key = target, None if noise > 0 else _rounded(model.reward[at][k])
            row.setdefault(key, [0.0, 0.0])[0] += model.prob[at][k]
    targets = ([] if following is None else [following]) + [-1] * bool(result[2] or result[3])
    for key in [(t, reward) for t in targets for reward in (_rounded(result[1]), None)]:
        if key in counts[at]:
            counts[at][key][1] += 1
            return True
    return False


def _rounded(reward: Any) -> float:
    """A reward to seven digits: some environments compute in single precision."""
    return float(f"{float(reward):.7g}")


def _unlikely(counts: Counts) -> str | None:
    """The frequency that the model makes too unlikely."""
    together: dict[int, list[float]] = {}
    for (state, action), row in counts.items():
        n = sum(count for _, count in row.values())
        for rank, ((target, _), (p, count)) in enumerate(row.items()):
            off, variance = count - n * p, n * p * (1 - p)
            if abs(off) > MOST_DEVIATIONS * math.sqrt(max(variance, FEWEST)):
                to = "the end" if target < 0 else target
                place = f"state {state}, action {action}: the step to {to}"
                place = f"reset: the start in state {to}" if (state, action) == START else place
                return f"{place} has a probability of {p:.3g}, it came {count:.0f} of {n:.0f} times"
            total = together.setdefault(rank, [0.0, 0.0])
            total[:] = total[0] + off, total[1] + variance
    for off, variance in together.values():
        if abs(off) > MOST_DEVIATIONS * math.sqrt(max(variance, FEWEST)):
            deviations = f"{abs(off) / math.sqrt(variance):.1f} standard deviations"
            return f"outcomes are {deviations} from their probabilities"
    return None
