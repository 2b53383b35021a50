"""Reachable states, from the arrays of `mdp.transition_model.TransitionModel`.

The model itself imports this module, so this module does not import the model.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import compiled

# As in the model's own module.
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
AnyInts = NDArray[np.integer]


def reached_from(
    start: Bools, prob: Floats, next_state: AnyInts, terminated: Bools, allowed: Bools
) -> Bools:
    """The states reachable from ``start`` by allowed actions, with ``start`` itself."""
    found = start.copy()
    # A single memory layout, so that Numba compiles once.
    allowed = np.ascontiguousarray(allowed)
    _flood(prob, next_state, terminated, allowed, found)
    return found


@compiled
def _flood(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    allowed: Bools,
    found: Bools,
) -> None:
    """Add all states reachable from ``found`` to ``found``, in place."""
    n_states, n_actions, n_outcomes = prob.shape
    stack = np.empty(n_states, np.int64)
    height = 0
    for state in range(n_states):
        if found[state]:
            stack[height] = state
            height += 1
    while height > 0:
        height -= 1
        state = stack[height]
        for action in range(n_actions):
            if not allowed[state, action]:
                continue
            for k in range(n_outcomes):
                reached = next_state[state, action, k]
                leads = prob[state, action, k] > 0 and not terminated[state, action, k]
                if leads and not found[reached]:
                    found[reached] = True
                    stack[height] = reached
                    height += 1
