"""Minibatches out of the library's replay buffer, in whose own arrays transitions lie.

With n-step returns as in `stable_baselines3.common.buffers.NStepReplayBuffer`: rewards are summed
until the episode ends, or the newest transition is reached. What VecNormalize shows otherwise lies
there as it was, and is shown by the statistics of the moment, as in the library.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.compiled.generators import next_uniform
from agents.networks.matrix_products import Singles
from agents.networks.observations import show
from agents.networks.perceptron import Inputs
from machine_code.compiling import inlined, kernel
from mdp.array_types import Floats, Ints


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


class Memory(NamedTuple):
    """What minibatches are drawn from, by reference.

    Attributes:
        replay: the transitions.
        batch: what is filled.
        place: says where the next transition will lie, and whether the ring is full.
        rules: with the discount factor, the number of steps and what VecNormalize does.
        centre: what it takes from observations, shape (d,).
        spread: what it divides them by, shape (d,).
        rng: a handle of the agent's generator, alone in an array.
        one_hot: whether observations are numbers of states.
    """

    replay: Replay
    batch: Minibatch
    place: NDArray[np.void]
    rules: NDArray[np.void]
    centre: Floats
    spread: Floats
    rng: NDArray[np.void]
    one_hot: int


@inlined
def clipped(number: float, bound: float) -> float:
    """As it is within the bound; what is not a number stays that."""
    if number > bound:
        return bound
    return -bound if number < -bound else number


@inlined
def show_normalised(memory: Memory, inputs: Inputs, i: int, row: Any) -> None:
    """As `show`, the way VecNormalize shows it now."""
    rules = memory.rules[0]
    if not rules.normalises_observations:
        show(inputs, i, row, memory.one_hot)
        return
    for j in range(len(row)):
        moved = (row[j] - memory.centre[j]) / memory.spread[j]
        inputs.vectors[i, j] = np.float32(clipped(moved, rules.clip_obs))


@inlined
def reward_of(memory: Memory, at: int, env: int) -> Any:
    """A reward, the way VecNormalize gives it now."""
    reward, rules = memory.replay.rewards[at, env], memory.rules[0]
    if not rules.normalises_rewards:
        return reward
    return np.float32(clipped(reward / rules.reward_spread, rules.clip_reward))


@kernel
def draw_minibatch(memory: Any, _: float, __: float) -> int:
    """Fill the minibatch with transitions drawn with replacement; their number is returned."""
    replay, batch, place = memory.replay, memory.batch, memory.place[0]
    rules, rng = memory.rules[0], memory.rng[0]
    n_places, n_envs = replay.rewards.shape
    filled = n_places if place.full else place.position
    newest = (place.position - 1) % n_places
    for i in range(len(batch.actions)):
        begin = int(next_uniform(rng) * filled)
        env = int(next_uniform(rng) * n_envs)
        at, discount, total = begin, np.float32(rules.gamma), reward_of(memory, begin, env)
        for _ in range(rules.n_steps - 1):
            if replay.dones[at, env] or replay.timeouts[at, env] or at == newest:
                break
            at = (at + 1) % n_places
            total += discount * reward_of(memory, at, env)
            discount *= np.float32(rules.gamma)
        if replay.dones[at, env] and not replay.timeouts[at, env]:
            discount = np.float32(0)
        show_normalised(memory, batch.states, i, replay.observations[begin, env])
        show_normalised(memory, batch.next_states, i, replay.next_observations[at, env])
        batch.actions[i] = replay.actions[begin, env, 0]
        batch.rewards[i] = total
        batch.discounts[i] = discount
    return len(batch.actions)
