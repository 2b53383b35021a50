"""The library's rollout buffer, whose own arrays are used: advantages, and minibatches of it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agents.compiled.generators import next_uniform
from agents.networks.matrix_products import Singles
from agents.networks.observations import show
from machine_code.compiling import called, inlined, kernel
from mdp.array_types import Ints


class Rollout(NamedTuple):
    """The library's rollout buffer but for observations: T steps of E environments.

    Attributes:
        actions: shape (T, E, 1).
        rewards: shape (T, E).
        episode_starts: 1 where an episode began with the observation, shape (T, E).
        values: of the observations, shape (T, E).
        log_probs: of the actions, shape (T, E).
        advantages: shape (T, E).
        returns: what the values are to be, shape (T, E).
    """

    actions: Ints
    rewards: Singles
    episode_starts: Singles
    values: Singles
    log_probs: Singles
    advantages: Singles
    returns: Singles


class RolloutMemory(NamedTuple):
    """What minibatches are taken from, by reference.

    Attributes:
        observations: shape (T, E, d); numbers of states have d = 1.
        rollout: the rest of the buffer.
        order: numbers of the rollout's steps, shuffled, shape (T * E,).
        batch: what is filled, a `RolloutMinibatch`.
        one_hot: whether observations are numbers of states.
    """

    observations: Any
    rollout: Rollout
    order: Ints
    batch: Any
    one_hot: int


@kernel
def estimate_advantages(learner: Any, _: float, __: float) -> int:
    """Generalised advantage estimation (Schulman et al., 2016), from the last step backwards."""
    rollout, rules = learner.rollout, learner.rules[0]
    n_steps, n_envs = rollout.rewards.shape
    gamma = rules.buffer_gamma
    for i in range(n_envs):
        advantage, next_value = 0.0, float(learner.last_values[i])
        goes_on = 1.0 - learner.starts[i]
        for step in range(n_steps - 1, -1, -1):
            value = float(rollout.values[step, i])
            error = rollout.rewards[step, i] + gamma * next_value * goes_on - value
            advantage = error + gamma * rules.gae_lambda * goes_on * advantage
            rollout.advantages[step, i] = np.float32(advantage)
            rollout.returns[step, i] = np.float32(advantage + value)
            next_value, goes_on = value, 1.0 - rollout.episode_starts[step, i]
    return 0


@called
def explained_variance(rollout: Rollout) -> float:
    """1 - Var(returns - values) / Var(returns), as in the library's log; nan for equal returns."""
    n_steps, n_envs = rollout.returns.shape
    n, mean, mean_error = n_steps * n_envs, 0.0, 0.0
    for step in range(n_steps):
        for i in range(n_envs):
            mean += rollout.returns[step, i] / n
            mean_error += (rollout.returns[step, i] - rollout.values[step, i]) / n
    variance = unexplained = 0.0
    for step in range(n_steps):
        for i in range(n_envs):
            error = rollout.returns[step, i] - rollout.values[step, i]
            variance += (rollout.returns[step, i] - mean) ** 2
            unexplained += (error - mean_error) ** 2
    return 1.0 - unexplained / variance if variance > 0 else math.nan


@inlined
def shuffle(numbers: Ints, handle: Any) -> None:
    """Put 0, 1, ... into a random order (Fisher and Yates)."""
    for i in range(len(numbers)):
        numbers[i] = i
    for i in range(len(numbers) - 1, 0, -1):
        j = int(next_uniform(handle) * (i + 1))
        numbers[i], numbers[j] = numbers[j], numbers[i]


@kernel
def pick_steps(memory: Any, begin: float, n: float) -> int:
    """Copy ``n`` steps of the rollout into the minibatch, in its order from ``begin`` on."""
    rollout, batch, first = memory.rollout, memory.batch, int(begin)
    n_envs = rollout.rewards.shape[1]
    for k in range(int(n)):
        number = memory.order[first + k]
        step, i = number // n_envs, number % n_envs
        show(batch.states, k, memory.observations[step, i], memory.one_hot)
        batch.actions[k] = int(rollout.actions[step, i, 0])
        batch.log_probs[k] = rollout.log_probs[step, i]
        batch.advantages[k] = rollout.advantages[step, i]
        batch.returns[k] = rollout.returns[step, i]
        batch.values[k] = rollout.values[step, i]
    return int(n)
