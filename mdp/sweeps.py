"""Sweeps over the states: the inner loops of planning, compiled.

All arrays are those of ``TransitionModel``; ``mean_reward`` and ``allowed`` have shape (S, A),
``values`` and ``floor`` shape (S,). ``order`` lists the states to sweep, nearest to the end of the
episode first: what a sweep finds near the end then reaches all the others in the same sweep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import AnyInts, Bools, Floats, Ints
from mdp.machine_code import compiled

TIE_TOLERANCE = 1e-12


@compiled
def improve(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    mean_reward: Floats,
    allowed: Bools,
    floor: Floats,
    discount: float,
    order: Ints,
    values: Floats,
    policy: Ints,
    tie: float,
) -> tuple[float, float]:
    """One Gauss-Seidel sweep of the Bellman optimality operator, in place.

    ``policy`` follows the best action, and moves only where another one is better by more than
    ``tie``, relative to the value where that is above 1.

    Returns:
        The largest rise and the largest fall of a value.
    """
    rise = 0.0
    fall = 0.0
    for state in order:
        best = -np.inf
        current = -np.inf
        best_action = -1
        for action in range(prob.shape[1]):
            if not allowed[state, action]:
                continue
            value = mean_reward[state, action]
            for k in range(prob.shape[2]):
                if prob[state, action, k] > 0 and not terminated[state, action, k]:
                    following = values[next_state[state, action, k]]
                    value += discount * prob[state, action, k] * following
            if value > best:
                best = value
                best_action = action
            if action == policy[state]:
                current = value
        if best > current + tie * max(1.0, abs(best)):
            policy[state] = best_action
        best = max(best, floor[state])
        change = best - values[state]
        rise = max(rise, change)
        fall = max(fall, -change)
        values[state] = best
    return rise, fall


@compiled
def first_guess(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    mean_reward: Floats,
    allowed: Bools,
    discount: float,
    known: Bools,
    order: Ints,
    values: Floats,
    policy: Ints,
) -> None:
    """Values and actions in one pass, as if what leads away from the end left the agent in place.

    Without chance these are the shortest paths. With it, each action still leads nearer to the
    end, or to the states ``known`` before, with positive probability wherever it can, so that the
    policy ends every episode. ``known``, bool of shape (S,), is extended on the way.
    """
    for state in order:
        best = -np.inf
        for action in range(prob.shape[1]):
            if not allowed[state, action]:
                continue
            value = mean_reward[state, action]
            staying = 0.0
            ahead = False
            for k in range(prob.shape[2]):
                if prob[state, action, k] > 0:
                    following = next_state[state, action, k]
                    if terminated[state, action, k]:
                        ahead = True
                    elif known[following]:
                        ahead = True
                        value += discount * prob[state, action, k] * values[following]
                    else:
                        staying += discount * prob[state, action, k]
            if (ahead or discount < 1) and value / (1 - staying) > best:
                best = value / (1 - staying)
                policy[state] = action
        values[state] = best
        known[state] = True


@compiled
def policy_rows(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    mean_reward: Floats,
    discount: float,
    order: Ints,
    policy: Ints,
) -> tuple[Floats, NDArray[np.int32], Floats, Floats]:
    """The rows that a policy uses, in the order of the sweep and with places in it for states.

    States that are not in the order count as ends.

    Returns:
        Discounted weights and places of the following states, both (n, K); rewards (n,); and the
        weight of all that does not lie further on in the order, (n,).
    """
    n_outcomes = prob.shape[2]
    place_of = np.full(prob.shape[0], -1, np.int32)
    for place in range(len(order)):
        place_of[order[place]] = place
    weight = np.zeros((len(order), n_outcomes))
    following = np.zeros((len(order), n_outcomes), np.int32)
    reward = np.empty(len(order))
    settled = np.ones(len(order))
    for place in range(len(order)):
        state = order[place]
        action = policy[state]
        reward[place] = mean_reward[state, action]
        for k in range(n_outcomes):
            leads = prob[state, action, k] > 0 and not terminated[state, action, k]
            target = place_of[next_state[state, action, k]]
            if leads and target >= 0:
                weight[place, k] = discount * prob[state, action, k]
                following[place, k] = target
                if target >= place:
                    settled[place] -= weight[place, k]
    return weight, following, reward, settled


@compiled
def evaluate(
    weight: Floats,
    following: NDArray[np.int32],
    reward: Floats,
    settled: Floats,
    values: Floats,
) -> float:
    """One sweep of the Bellman operator of a policy over its rows, in place.

    Each change is divided by ``settled``: as if the states further on, whose turn comes later,
    were to change by as much. Chance that leads back holds values to where they were; this lets
    go of them (successive over-relaxation, with its factor chosen state by state).

    Returns:
        The largest change.
    """
    largest = 0.0
    for place in range(len(reward)):
        value = reward[place]
        for k in range(weight.shape[1]):
            value += weight[place, k] * values[following[place, k]]
        change = (value - values[place]) / settled[place]
        values[place] += change
        largest = max(largest, abs(change))
    return largest


@compiled
def residuals(
    weight: Floats, following: NDArray[np.int32], reward: Floats, values: Floats
) -> Floats:
    """What one more step of a policy would change in each value of its rows, shape (n,)."""
    result = np.empty(len(reward))
    for place in range(len(reward)):
        value = reward[place] - values[place]
        for k in range(weight.shape[1]):
            value += weight[place, k] * values[following[place, k]]
        result[place] = value
    return result


@compiled
def action_values(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    mean_reward: Floats,
    allowed: Bools,
    discount: float,
    values: Floats,
) -> Floats:
    """Values of shape (S, A) of taking an action and going on as well as ``values`` says.

    Actions that are not allowed get minus infinity.
    """
    result = np.full(mean_reward.shape, -np.inf)
    for state in range(prob.shape[0]):
        for action in range(prob.shape[1]):
            if allowed[state, action]:
                value = mean_reward[state, action]
                for k in range(prob.shape[2]):
                    if prob[state, action, k] > 0 and not terminated[state, action, k]:
                        following = values[next_state[state, action, k]]
                        value += discount * prob[state, action, k] * following
                result[state, action] = value
    return result
