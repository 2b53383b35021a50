"""Episodes in which nothing is random: where each state's one way leads, by doubling.

What 2 n steps from a state earn is what n steps earn from there, and n more from where those lead:
a time limit of T takes log2(T) rounds over the states, however often a way goes round in circles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdp.array_types import AnyInts, Bools, Floats


@dataclass(frozen=True, eq=False)
class Ways:
    """What some number of steps from each state comes to; the last entry stands for the end.

    Attributes:
        earned: the (discounted) sum of rewards, shape (n + 1,).
        length: the number of steps until then or the end, shape (n + 1,).
        success: whether the episode has ended well by then, shape (n + 1,).
        leads_to: the state after them, shape (n + 1,).
    """

    earned: Floats
    length: Floats
    success: Bools
    leads_to: AnyInts

    def followed_by(self, then: Ways, discount: float) -> Ways:
        """These steps and then others, whose rewards count ``discount`` times."""
        place = self.leads_to
        return Ways(
            self.earned + discount * then.earned[place],
            self.length + then.length[place],
            self.success | then.success[place],
            then.leads_to[place],
        )


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
    n = len(reward)
    ended = np.append(np.where(terminated, n, next_state), n)
    step = Ways(
        np.append(reward, 0.0),
        np.append(np.ones(n), 0.0),
        np.append(success & terminated, False),
        ended,
    )
    nothing = np.zeros(n + 1)
    total = Ways(nothing, nothing, np.zeros(n + 1, np.bool_), np.arange(n + 1))
    n_done, n_steps = 0, 1
    while True:
        if horizon & n_steps:
            total = total.followed_by(step, discount**n_done)
            n_done += n_steps
        if n_done == horizon:
            break
        step = step.followed_by(step, discount**n_steps)
        n_steps *= 2
    moments = np.zeros((n, 5))
    moments[:, 0], moments[:, 2] = total.earned[:n], total.length[:n]
    moments[:, 4] = total.success[:n]
    return moments
