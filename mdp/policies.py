"""The forms in which a policy may be given.

- Float of shape (S, A): the probabilities of the actions in each state.
- Integer of shape (S,): the action in each state.
- Integer of shape (horizon, S): the action at each step in each state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import AnyInts, Bools, Floats, Ints
from mdp.transition_model import TransitionModel

Policy = NDArray[np.floating] | AnyInts

# Networks work in float32, whose probabilities sum to one within some 1e-7.
POLICY_TOLERANCE = 1e-5


def canonical_policy(model: TransitionModel, policy: Policy, horizon: int | None) -> Policy:
    """The policy as a float64 matrix (S, A), or as actions of shape (1 or horizon, S)."""
    n_states, n_actions = model.n_states, model.n_actions
    if np.issubdtype(policy.dtype, np.integer):
        actions: AnyInts = np.atleast_2d(policy)
        if actions.shape not in {(1, n_states), (horizon, n_states)}:
            raise ValueError(
                f"actions have shape {policy.shape}, they must have ({n_states},), or "
                f"({horizon}, {n_states}) under a time limit"
            )
        taken = actions[:, model.reachable]
        if taken.min() < 0 or taken.max() >= n_actions:
            raise ValueError(f"the policy takes an action outside 0..{n_actions - 1}")
        return actions
    if policy.shape != (n_states, n_actions):
        raise ValueError(
            f"the policy matrix has shape {policy.shape}, it must have ({n_states}, {n_actions})"
        )
    matrix = policy.astype(np.float64)
    total = matrix.sum(axis=1)
    # Written so that a NaN fails.
    valid = (matrix >= 0).all(axis=1) & (np.abs(total - 1) <= POLICY_TOLERANCE)
    if not valid[model.reachable].all():
        state = np.flatnonzero(model.reachable & ~valid)[0]
        raise ValueError(f"in state {state} the policy's probabilities are {policy[state]}")
    matrix[valid] /= total[valid, None]
    return matrix


def chances_in(model: TransitionModel, policy: Policy, states: Ints) -> Floats:
    """The probabilities of actions in the listed states, shape (1 or horizon, n, A)."""
    if np.issubdtype(policy.dtype, np.integer):
        return np.eye(model.n_actions)[policy[:, states]]
    return np.ascontiguousarray(policy[None, states], np.float64)


def policy_matrix(model: TransitionModel, policy: Policy) -> Floats:
    """The probabilities of actions in all states, shape (S, A), of a stationary policy."""
    matrix: Floats = chances_in(model, policy, np.arange(model.n_states))[0]
    return matrix


def actions_used(model: TransitionModel, policy: Policy) -> Bools:
    """The actions that the policy may take at some step, bool of shape (S, A)."""
    if not np.issubdtype(policy.dtype, np.integer):
        return policy > 0
    used = np.zeros((model.n_states, model.n_actions), np.bool_)
    used[np.arange(model.n_states), np.clip(policy, 0, model.n_actions - 1)] = True
    return used
