"""Noisy observations (readings) of a hidden state, as a part of the state.

The observation of a finite environment is a function of its state (`observation_of`). Where
readings are random, the state holds the last one beside the hidden state. So steps, exact figures
and compiled training need no code for noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.finite_env import summing_to_one
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel


class World(NamedTuple):
    """A decision process with readings."""

    model: TransitionModel  # its states are pairs of hidden state and last reading
    hidden: Ints  # the hidden state in each state, shape (S,)
    reading: Ints  # the last reading in each state, shape (S,)


def with_readings(hidden: TransitionModel, first: Floats, later: Floats) -> World:
    """Add readings to a decision process whose states are hidden.

    Args:
        hidden: the decision process; H states, A actions.
        first: the probability of each reading in a starting state, shape (H, O).
        later: the probability of each reading after an action that led to a state, shape (A, H, O).
            Where the episode ends, only the first reading that is possible is kept.
    """
    n_hidden, n_actions, n_outcomes = hidden.prob.shape
    n_readings = first.shape[-1]
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
    # Possible outcomes first, in their order, and no more columns than needed.
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
