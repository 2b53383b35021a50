"""Noisy readings of what is hidden, as a part of the state.

A finite environment says what is observed in each state (`observation_of`). Where a reading is
drawn, the state holds the last one besides what is hidden. So steps, exact figures and compiled
training need to know nothing of noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.finite_env import summing_to_one
from mdp.transition_model import Floats, Ints, TransitionModel


class World(NamedTuple):
    """A decision process with readings."""

    model: TransitionModel  # its states are pairs of what is hidden and the last reading
    hidden: Ints  # what is hidden in each state, shape (S,)
    reading: Ints  # the last reading in each state, shape (S,)


def with_readings(hidden: TransitionModel, first: Floats, later: Floats) -> World:
    """Add readings to a decision process whose states are hidden.

    Args:
        hidden: the decision process; H states, A actions.
        first: the chance of each reading in the state in which an episode begins, shape (H, O).
        later: the chance of each reading after an action that has led to a state, shape (A, H, O).
            Of an episode's last reading only one is kept, the first that is possible.

    Raises:
        ValueError: if the shapes disagree or chances do not sum to one.
    """
    n_hidden, n_actions, n_outcomes = hidden.prob.shape
    n_readings = first.shape[-1]
    if first.shape != (n_hidden, n_readings) or later.shape != (n_actions, *first.shape):
        raise ValueError(
            f"first has shape {first.shape} and later {later.shape}, they must be "
            f"({n_hidden}, readings) and ({n_actions}, {n_hidden}, readings)"
        )
    for name, chances in (("first", first), ("later", later)):
        if not (chances >= 0).all() or not np.allclose(chances.sum(axis=-1), 1):
            raise ValueError(f"{name} has readings whose chances do not sum to one")
    is_there = (first > 0) | (later > 0).any(axis=0)
    state_hidden, state_reading = np.nonzero(is_there)
    number = np.zeros(is_there.shape, np.int64)
    number[is_there] = np.arange(len(state_hidden))

    action = np.arange(n_actions)[None, :, None]
    chances = later[action, hidden.next_state]  # (H, A, K, O)
    last = np.eye(n_readings)[(chances > 0).argmax(axis=3)]
    chances = np.where(hidden.terminated[..., None], last, chances)
    joint = hidden.prob[..., None] * chances
    shape = (n_hidden, n_actions, n_outcomes * n_readings)
    following = number[hidden.next_state[..., None], np.arange(n_readings)]
    # What is possible first, in its order, and no more columns than needed.
    possible = joint.reshape(shape) > 0
    order = np.argsort(~possible, axis=2, kind="stable")[:, :, : int(possible.sum(axis=2).max())]

    def of_states(array: NDArray[Any]) -> NDArray[Any]:
        full = np.broadcast_to(array, joint.shape).reshape(shape)
        return np.take_along_axis(full, order, axis=2)[state_hidden]

    model = TransitionModel(
        prob=summing_to_one(of_states(joint)),
        next_state=of_states(following),
        reward=of_states(hidden.reward[..., None]),
        terminated=of_states(hidden.terminated[..., None]),
        initial=summing_to_one(hidden.initial[state_hidden] * first[state_hidden, state_reading]),
    )
    return World(model, state_hidden, state_reading)
