"""Minibatches out of the library's replay buffer, in whose own arrays transitions lie.

With n-step returns as in `stable_baselines3.common.buffers.NStepReplayBuffer`: rewards are summed
until the episode ends, or the newest transition is reached.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.compiled.generators import next_uniform
from agents.networks.matrix_products import Singles
from agents.networks.perceptron import Inputs
from mdp.array_types import Ints
from mdp.machine_code import called, inlined


class Replay(NamedTuple):
    """Transitions of E environments in rings of N places.

    Attributes:
        observations: shape (N, E, d); numbers of states have d = 1.
        next_observations: what followed, before any reset, likewise.
        actions: shape (N, E, 1).
        rewards: shape (N, E).
        dones: 1 where the episode ended, shape (N, E).
        timeouts: 1 where it ended by its time limit alone, shape (N, E).
    """

    observations: Any
    next_observations: Any
    actions: Ints
    rewards: Singles
    dones: Singles
    timeouts: Singles


class Minibatch(NamedTuple):
    """Transitions that are learnt from at once.

    Attributes:
        states: observations, of B rows.
        next_states: what followed.
        actions: shape (B,).
        rewards: discounted sums of the rewards in between, shape (B,).
        discounts: factor of the value of what followed, 0 where nothing does, shape (B,).
    """

    states: Inputs
    next_states: Inputs
    actions: Ints
    rewards: Singles
    discounts: Singles


@inlined
def show(inputs: Inputs, i: int, row: Any, one_hot: bool) -> None:
    """Put a row of a buffer into the i-th of the inputs."""
    if one_hot:
        inputs.indices[i] = int(row[0])
    else:
        for j in range(len(row)):
            inputs.vectors[i, j] = np.float32(row[j])


@called
def draw_minibatch(
    replay: Replay, batch: Minibatch, place: Any, rules: Any, one_hot: bool, rng: Any
) -> None:
    """Fill the minibatch with transitions drawn with replacement.

    Args:
        replay: where they are drawn from.
        batch: what is filled.
        place: says where the next transition will lie, and whether the ring is full.
        rules: with the discount factor and the number of steps.
        one_hot: whether observations are numbers of states.
        rng: a handle of the generator.
    """
    n_places, n_envs = replay.rewards.shape
    filled = n_places if place.full else place.position
    newest = (place.position - 1) % n_places
    for i in range(len(batch.actions)):
        begin = int(next_uniform(rng) * filled)
        env = int(next_uniform(rng) * n_envs)
        at, discount, total = begin, np.float32(rules.gamma), replay.rewards[begin, env]
        for _ in range(rules.n_steps - 1):
            if replay.dones[at, env] or replay.timeouts[at, env] or at == newest:
                break
            at = (at + 1) % n_places
            total += discount * replay.rewards[at, env]
            discount *= np.float32(rules.gamma)
        if replay.dones[at, env] and not replay.timeouts[at, env]:
            discount = np.float32(0)
        show(batch.states, i, replay.observations[begin, env], one_hot)
        show(batch.next_states, i, replay.next_observations[at, env], one_hot)
        batch.actions[i] = replay.actions[begin, env, 0]
        batch.rewards[i] = total
        batch.discounts[i] = discount
