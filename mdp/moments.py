"""Means and variances of a policy's episodes under a time limit, compiled.

The arrays have the shapes of ``TransitionModel``, restricted to the n states that the policy
visits, with ``next_state`` counting in those. ``policy`` has shape (T, n, A): T = 1 for a
stationary policy, T = horizon for one that changes with the step.
"""

from __future__ import annotations

import numpy as np

from mdp.array_types import Bools, Floats, Ints
from mdp.machine_code import called, compiled


@compiled
def moments_under_limit(
    prob: Floats,
    next_state: Ints,
    terminated: Bools,
    reward: Floats,
    success: Bools,
    policy: Floats,
    horizon: int,
    discount: float,
) -> Floats:
    """Moments of the episodes that start in each state.

    The variances are sums of squared deviations, so that they keep their digits where the mean is
    large (Sobel, The Variance of Discounted Markov Decision Processes, 1982).

    Returns:
        Shape (n, 5): mean and variance of the return, mean and variance of the length, and the
        probability of success.
    """
    later = np.zeros((prob.shape[0], 5))
    now = np.zeros((prob.shape[0], 5))
    for step in range(horizon - 1, -1, -1):
        chances = policy[min(step, policy.shape[0] - 1)]
        changed = False
        for state in range(prob.shape[0]):
            outcomes = (prob[state], next_state[state], terminated[state], reward[state])
            _means(*outcomes, success[state], chances[state], discount, later, now[state])
            _variances(*outcomes, chances[state], discount, later, now[state])
            for moment in range(5):
                changed = changed or now[state, moment] != later[state, moment]
        now, later = later, now
        # One more step has changed nothing: nor will any further one.
        if not changed and policy.shape[0] == 1:
            break
    return later


@called
def _means(
    prob: Floats,
    next_state: Ints,
    terminated: Bools,
    reward: Floats,
    success: Bools,
    chances: Floats,
    discount: float,
    later: Floats,
    now: Floats,
) -> None:
    """The means of one state, from its rows of the model and the moments one step later."""
    now[0] = 0.0
    now[2] = 1.0
    now[4] = 0.0
    for action in range(prob.shape[0]):
        for k in range(prob.shape[1]):
            weight = chances[action] * prob[action, k]
            if weight > 0:
                now[0] += weight * reward[action, k]
                now[4] += weight * success[action, k]
                if not terminated[action, k]:
                    after = later[next_state[action, k]]
                    now[0] += weight * discount * after[0]
                    now[2] += weight * after[2]
                    now[4] += weight * after[4]


@called
def _variances(
    prob: Floats,
    next_state: Ints,
    terminated: Bools,
    reward: Floats,
    chances: Floats,
    discount: float,
    later: Floats,
    now: Floats,
) -> None:
    """The variances of one state: of the means that may follow, and the mean of theirs."""
    now[1] = 0.0
    now[3] = 0.0
    for action in range(prob.shape[0]):
        for k in range(prob.shape[1]):
            weight = chances[action] * prob[action, k]
            if weight > 0:
                result = reward[action, k]
                length = 1.0
                if not terminated[action, k]:
                    after = later[next_state[action, k]]
                    result += discount * after[0]
                    length += after[2]
                    now[1] += weight * discount * discount * after[1]
                    now[3] += weight * after[3]
                now[1] += weight * (result - now[0]) ** 2
                now[3] += weight * (length - now[2]) ** 2


@compiled
def visits_under_limit(
    prob: Floats,
    next_state: Ints,
    terminated: Bools,
    policy: Floats,
    initial: Floats,
    horizon: int,
) -> Floats:
    """The expected number of steps taken in each state, shape (n,)."""
    visits = np.zeros(len(initial))
    here = initial.copy()
    for step in range(horizon):
        chances = policy[min(step, policy.shape[0] - 1)]
        there = np.zeros(len(initial))
        left = 0.0
        for state in range(len(initial)):
            visits[state] += here[state]
            if here[state] == 0:
                continue
            for action in range(prob.shape[1]):
                for k in range(prob.shape[2]):
                    weight = here[state] * chances[state, action] * prob[state, action, k]
                    if weight > 0 and not terminated[state, action, k]:
                        there[next_state[state, action, k]] += weight
                        left += weight
        here = there
        if left == 0:
            break
    return visits
