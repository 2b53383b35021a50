"""The best that can be done by what is observed, where several states look alike.

Which stationary policy is best then is a hard problem (Littman, Memoryless Policies: Theoretical
Limitations and Practical Results, 1994), and it may have to be random. What is found here is a
lower bound: the best of several ascents along the exact gradient.
"""

from __future__ import annotations

import numpy as np

from mdp.gaps import policy_gradient
from mdp.transition_model import Floats, Ints, TransitionModel

# Outcomes of all states at all steps, beyond which the ascents take too long.
MOST_OUTCOMES_CLIMBED = 5_000_000
RANDOM_STARTS = 4
# A policy that all but surely takes an action: further ascent changes its return by rounding.
STEEP = 6.0


def best_memoryless(model: TransitionModel, groups: Ints, horizon: int) -> float | None:
    """The highest return found of policies that go by the group of a state alone.

    Args:
        model: the decision process.
        groups: the number of what is observed in each state, from 0 on, shape (S,).
        horizon: the time limit in steps.

    Returns:
        The return of a policy that was found; None where the search would take too long.
    """
    from scipy.optimize import minimize

    if model.prob.size * horizon > MOST_OUTCOMES_CLIMBED:
        return None
    n_groups, n_actions = int(groups.max()) + 1, model.n_actions

    def downhill(flat: Floats) -> tuple[float, Floats]:
        logits = flat.reshape(n_groups, n_actions)
        shares = _softmax(logits)
        value, slope = policy_gradient(model, shares[groups], horizon)
        by_group = np.zeros((n_groups, n_actions))
        np.add.at(by_group, groups, slope)
        mean = (shares * by_group).sum(axis=1, keepdims=True)
        return -value, -(shares * (by_group - mean)).ravel()

    rng = np.random.default_rng(0)
    starts = [np.zeros((n_groups, n_actions))]
    starts += [np.tile(STEEP * row, (n_groups, 1)) / 2 for row in np.eye(n_actions)]
    starts += [rng.normal(size=(n_groups, n_actions)) for _ in range(RANDOM_STARTS)]
    found = -np.inf
    for start in starts:
        end = minimize(downhill, start.ravel(), jac=True, method="L-BFGS-B")
        firm = np.eye(n_actions)[end.x.reshape(n_groups, n_actions).argmax(axis=1)]
        found = max(found, -float(end.fun), policy_gradient(model, firm[groups], horizon)[0])
    return found


def _softmax(logits: Floats) -> Floats:
    powers = np.exp(logits - logits.max(axis=1, keepdims=True))
    shares: Floats = powers / powers.sum(axis=1, keepdims=True)
    return shares
