"""Whether an environment does what a model of it says: 20,000 steps of it, outcome by outcome.

One outcome that the model calls impossible refutes it. So does a frequency that lies six standard
deviations from its expectation: of one start, of one outcome of one state and action, or of the
first outcomes of all states and actions together, the second ones, and so on.
"""

from __future__ import annotations

import itertools
import math
import random
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.envs.model_of.symbols import Limit, stopwatch
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

STEPS, STEPS_PER_START = 20_000, 40
MOST_DEVIATIONS = 6.0
LEGAL = 0.95  # share of steps for which an action is chosen that is allowed
FEWEST = 9.0  # a variance below which counts are far from normally distributed


NO_START = "the environment starts in a state ({}) that is no start"
# Of a start, or of a state and action: {(next state, -1 at the end; reward, None if random):
# [probability, count]}.
Row = dict[tuple[int | None, float | None], list[float]]


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
    seed: int = 2,
    seconds: float = math.inf,
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
        seconds: the time after which the test gives up.

    Raises:
        Limit: if it gives up.
    """
    rng = np.random.default_rng([seed, 1])  # no numbers that the environment draws
    initial, state, time, spent = model.initial, None, 0, stopwatch()
    starts: Row = {(s, 0.0): [initial[s], 0.0] for s in np.flatnonzero(initial).tolist()}
    rows = {"reset": starts}
    with seeded_globally(seed):
        for taken, drawn in enumerate(rng.integers(len(actions), size=steps).tolist()):
            if spent() > seconds:
                told = f"{steps:,} steps, by which every model is tested, take too long"
                raise Limit(f"{told}: {taken:,} in {seconds:g} seconds")
            if state is None:
                seen, _ = env.reset(seed=None if taken else seed)
                state, time = state_of(seen, 0), 0
                if state is None or not _count(starts, [state], 0.0):
                    return NO_START.format(seen)
            action, is_legal = drawn, mask is None or mask[state, drawn]
            if mask is not None and not is_legal and rng.random() < LEGAL:
                action, is_legal = int(rng.choice(np.flatnonzero(mask[state]))), True
            place = f"state {state}, action {action}"
            try:
                seen, reward, terminated, truncated, _ = env.step(actions[action])
            except Exception:
                if is_legal:
                    raise
                state = None
                continue
            if not is_legal:
                return f"{place}: the environment allows it"
            time += 1
            row = rows.get(place) or rows.setdefault(place, _row(model, state, action))
            state = None if terminated else state_of(seen, time)
            if not _count(row, [state, -1] if truncated else [-1 if terminated else state], reward):
                made = "the end" if terminated else "such a state" if state is None else state
                made = f"step to {made} with the reward {float(reward):g}"
                return f"{place}: the model has no {made}, the environment made one"
            state = None if truncated else state
        for _ in range(steps // STEPS_PER_START if len(starts) > 1 else 0):
            seen, _ = env.reset()
            if not _count(starts, [state_of(seen, 0)], 0.0):
                return NO_START.format(seen)
    return _unlikely(rows)


def _row(model: TransitionModel, state: int, action: int) -> Row:
    """What the model says of an action."""
    at, row = (state, action), Row()
    noise = 0 * model.prob[at] if model.reward_variance is None else model.reward_variance[at]
    for k in np.flatnonzero(model.prob[at] > 0):
        target = -1 if model.terminated[at][k] else int(model.next_state[at][k])
        key = target, None if noise[k] > 0 else _rounded(model.reward[at][k])
        row.setdefault(key, [0.0, 0.0])[0] += model.prob[at][k]
    return row


def _count(row: Row, targets: list[int | None], reward: Any) -> bool:
    """Count an outcome, which leads to one of the targets; False if the row does not have it."""
    for key in itertools.product(targets, (_rounded(reward), None)):
        if key in row:
            row[key][1] += 1
            return True
    return False


def _rounded(reward: Any) -> float:
    """A reward to seven digits: some environments compute in single precision."""
    return float(f"{float(reward):.7g}")


def _unlikely(rows: dict[str, Row]) -> str | None:
    """The frequency that the model makes too unlikely."""
    together: dict[int, Any] = defaultdict(lambda: np.zeros(2))
    for place, row in rows.items():
        n = sum(count for _, count in row.values())
        for rank, ((target, _), (p, count)) in enumerate(row.items()):
            off, variance = count - n * p, n * p * (1 - p)
            together[rank] += off, variance
            if _deviations(off, variance) > MOST_DEVIATIONS:
                what = "start in state" if place == "reset" else "step to"
                what += f" {'the end' if target == -1 else target} has a probability of {p:.3g}"
                return f"{place}: the {what}, it came {count:.0f} of {n:.0f} times"
    for total in together.values():
        if (far := _deviations(*total)) > MOST_DEVIATIONS:
            return f"outcomes are {far:.1f} standard deviations from their probabilities"
    return None


def _deviations(off: float, variance: float) -> float:
    """How many standard deviations a count is off."""
    return abs(off) / math.sqrt(max(variance, FEWEST))
