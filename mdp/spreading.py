"""A policy's episodes followed forwards: how the probability spreads from the starting states.

On large state spaces an episode is in few of them at any one step. Backwards, every state that it
might come to takes part in every step of the time limit; forwards, those where it may be now.
"""

from __future__ import annotations

import numpy as np

from mdp.array_types import AnyInts, Bools, Floats, Ints
from mdp.machine_code import compiled, inlined, kernel

Rows = tuple[Floats, AnyInts, Bools, Floats, Bools]

# No more than this share of the episodes may be left out, since they are so rare.
SHARE_LEFT_OUT = 1e-15


def least_probability(n_states: int, horizon: int) -> float:
    """States that are less likely at a step than this may be left out.

    If all of them were, at all steps, `SHARE_LEFT_OUT` would be missing.
    """
    return SHARE_LEFT_OUT / (n_states * horizon)


def moments_by_spreading(
    rows: Rows,
    policy: Floats,
    initial: Floats,
    horizon: int,
    discount: float,
    floor: float = -np.inf,
) -> Floats:
    """Mean and variance of the return, of the length, and the probability of success.

    Groups of episodes that are in the same state at the same step are one: its probability, the
    mean of its returns so far, and their sum of squared deviations, which keeps its digits where
    the mean is large.

    Args:
        rows: prob, next_state, terminated, reward of `TransitionModel`, and the outcomes that count
            as success; all of shape (S, A, K).
        policy: the probabilities of the actions, shape (S, A).
        initial: probabilities of the starting states, shape (S,).
        horizon: the time limit in steps.
        discount: from 0 to 1.
        floor: give up as soon as the mean return surely is below this. Minus infinity for never,
            which it has to be where there is a discount.

    Returns:
        Shape (5,); a mean return of minus infinity where it was given up.
    """
    n_states = len(initial)
    now, later = np.zeros((n_states, 3)), np.zeros((n_states, 3))
    now[:, 0] = initial
    here, there = np.zeros(n_states, np.int64), np.zeros(n_states, np.int64)
    starts = np.flatnonzero(initial)
    here[: len(starts)] = starts
    over = np.zeros((3, 3))
    least = least_probability(n_states, horizon)
    limits = _best_rewards(rows[0], rows[2], rows[3])
    groups = now, later, here, there
    if not _follow(
        rows, policy, groups, len(starts), over, horizon, discount, least, limits, floor
    ):
        return np.array([-np.inf, *[np.nan] * 4])
    (ended, mean, spread), (_, length, length_spread), (good, _, _) = over.tolist()
    return np.array([mean, spread / ended, length, length_spread / ended, good])


@kernel
def _follow(
    rows: Rows,
    policy: Floats,
    groups: tuple[Floats, Floats, Ints, Ints],
    n_here: int,
    over: Floats,
    horizon: int,
    discount: float,
    least: float,
    limits: tuple[float, float],
    floor: float,
) -> bool:
    """Follow the episodes from step to step; False where their mean return is below the floor.

    Args:
        rows: as in `moments_by_spreading`, and so are all that are not named here.
        policy: likewise.
        groups: what is in each state now and one step later, both (S, 3); and the states of which
            that is true, both (S,), in any order.
        n_here: how many states there are at the beginning.
        over: returns and lengths of the episodes that are over, (3, 3): a group of returns, one of
            lengths, and the probability of success.
        horizon: likewise.
        discount: likewise.
        least: states that are less likely are left out.
        limits: the highest rewards of an end and of another step.
        floor: likewise.
    """
    now, later, here, there = groups
    factor = 1.0
    for step in range(horizon):
        n_there, before = 0, over[0, 0]
        hope = over[0, 0] * over[0, 1]
        to_come = _most_to_come(limits, horizon - step)
        for i in range(n_here):
            state = here[i]
            hope += now[state, 0] * (now[state, 1] + to_come)
            if now[state, 0] >= least:
                is_last = step == horizon - 1
                n_there = _spread(
                    rows, policy, state, now, factor, is_last, later, there, n_there, over
                )
            now[state, 0] = now[state, 1] = now[state, 2] = 0.0
        if hope < floor:
            return False
        _merge(over, 1, over[0, 0] - before, step + 1.0, 0.0)
        now, later = later, now
        here, there = there, here
        n_here = n_there
        factor *= discount
        if n_here == 0:
            break
    return True


@inlined
def _spread(
    rows: Rows,
    policy: Floats,
    state: int,
    now: Floats,
    factor: float,
    is_last: bool,
    later: Floats,
    there: Ints,
    n_there: int,
    over: Floats,
) -> int:
    """Let the episodes that are in one state take a step; how many states there are then."""
    prob, next_state, terminated, reward, success = rows
    at, mean, variance = now[state, 0], now[state, 1], now[state, 2] / now[state, 0]
    for action in range(prob.shape[1]):
        if policy[state, action] == 0:
            continue
        for k in range(prob.shape[2]):
            chance = at * policy[state, action] * prob[state, action, k]
            if chance == 0:
                continue
            result = mean + factor * reward[state, action, k]
            if terminated[state, action, k] or is_last:
                _merge(over, 0, chance, result, variance * chance)
                is_good = terminated[state, action, k] and success[state, action, k]
                over[2, 0] += chance * is_good
                continue
            place = next_state[state, action, k]
            if later[place, 0] == 0:
                there[n_there] = place
                n_there += 1
            _merge(later, place, chance, result, variance * chance)
    return n_there


@inlined
def _merge(groups: Floats, place: int, chance: float, mean: float, spread: float) -> None:
    """Add episodes to a group: their probability, mean, and sum of squared deviations.

    Chan, Golub and LeVeque, Updating Formulae and a Pairwise Algorithm, 1979.
    """
    if chance > 0:
        total = groups[place, 0] + chance
        gap = mean - groups[place, 1]
        share = chance / total
        groups[place, 2] += spread + gap * gap * groups[place, 0] * share
        groups[place, 1] += gap * share
        groups[place, 0] = total


@inlined
def _most_to_come(limits: tuple[float, float], n_steps: int) -> float:
    """No episode earns more than this in so many steps."""
    best_end, best_step = limits
    on_the_way = best_step * (n_steps - 1) if best_step > 0 else 0.0
    unfinished = best_step * n_steps if best_step > -np.inf else -np.inf
    return max(best_end + on_the_way, unfinished)


@compiled
def _best_rewards(prob: Floats, terminated: Bools, reward: Floats) -> tuple[float, float]:
    """The highest reward of an end, and of a step that is none; minus infinity without any."""
    best_end, best_step = -np.inf, -np.inf
    for state in range(prob.shape[0]):
        for action in range(prob.shape[1]):
            for k in range(prob.shape[2]):
                if prob[state, action, k] > 0 and terminated[state, action, k]:
                    best_end = max(best_end, reward[state, action, k])
                elif prob[state, action, k] > 0:
                    best_step = max(best_step, reward[state, action, k])
    return best_end, best_step
