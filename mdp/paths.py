"""Episodes in which nothing is random: where each state's one way leads, by doubling.

What 2 n steps from a state earn is what n steps earn from there, and n more from where those lead:
a time limit of T takes log2(T) rounds over the states, however often a way goes round in circles.
"""

from __future__ import annotations

import numpy as np

from mdp.array_types import AnyInts, Bools, Floats, Ints
from mdp.machine_code import compiled

# What some number of steps from each state comes to, each of shape (n + 1,); the last entry stands
# for the end. The (discounted) sum of rewards, the number of steps until then or the end, whether
# the episode has ended well by then, and the state after them.
Ways = tuple[Floats, Floats, Bools, Ints]


def moments_along_ways(
    next_state: AnyInts,
    terminated: Bools,
    reward: Floats,
    success: Bools,
    horizon: int,
    discount: float,
) -> Floats:
    """As `mdp.moments.moments_under_limit`, where each state has one outcome.

    Args:
        next_state: where it leads, counting in these n states, shape (n,).
        terminated: whether it ends the episode, shape (n,).
        reward: what it earns, shape (n,).
        success: whether that is a good end, shape (n,).
        horizon: the time limit in steps.
        discount: from 0 to 1.

    Returns:
        Shape (n, 5), the variances zero.
    """
    moments = np.zeros((len(reward), 5))
    total = _walked(next_state.astype(np.int64), terminated, reward, success, horizon, discount)
    for place, part in zip((0, 2, 4), total[:3], strict=True):
        moments[:, place] = part[:-1]
    return moments


@compiled
def _walked(
    next_state: Ints,
    terminated: Bools,
    reward: Floats,
    success: Bools,
    horizon: int,
    discount: float,
) -> Ways:
    """All steps of the limit from each state, out of powers of two of them."""
    n = len(reward)
    step = np.zeros(n + 1), np.ones(n + 1), np.zeros(n + 1, np.bool_), np.full(n + 1, n)
    step[1][n] = 0.0
    for state in range(n):
        step[0][state] = reward[state]
        step[2][state] = success[state] and terminated[state]
        if not terminated[state]:
            step[3][state] = next_state[state]
    total = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1, np.bool_), np.arange(n + 1)
    n_done, n_steps = 0, 1
    while True:
        if horizon & n_steps:
            total = _followed(total, step, discount ** float(n_done))
            n_done += n_steps
        if n_done == horizon:
            return total
        step = _followed(step, step, discount ** float(n_steps))
        n_steps *= 2


@compiled
def _followed(first: Ways, then: Ways, discount: float) -> Ways:
    """Some steps and then others, whose rewards count ``discount`` times."""
    n = len(first[0])
    both = np.empty(n), np.empty(n), np.empty(n, np.bool_), np.empty(n, np.int64)
    for state in range(n):
        place = first[3][state]
        both[0][state] = first[0][state] + discount * then[0][place]
        both[1][state] = first[1][state] + then[1][place]
        both[2][state] = first[2][state] or then[2][place]
        both[3][state] = then[3][place]
    return both
