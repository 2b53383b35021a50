"""One step of proximal policy optimisation on a minibatch.

A2C is the same with one minibatch of the whole rollout and nothing clipped (Huang et al., 2022):
the ratio of probabilities is 1 then.

Source: Schulman et al. (2017), in the form of Stable-Baselines3.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agents.networks.categorical import fill_probabilities, log_normalizer, turn_into_slopes
from agents.networks.matrix_products import Singles
from agents.networks.optimizers import descend
from agents.networks.perceptron import Inputs, backward, forward, last_outputs
from machine_code.compiling import called, kernel
from mdp.array_types import Ints

# What the library's log has of a minibatch.
LOSSES = np.dtype(
    [
        ("policy_gradient", np.float64),
        ("likelihood", np.float64),  # minus the mean of advantage times log-probability
        ("value", np.float64),
        ("entropy", np.float64),
        ("total", np.float64),
        ("kl", np.float64),  # Schulman's estimate
        ("clipped", np.float64),  # share of the ratios
    ],
    align=True,
)


class RolloutMinibatch(NamedTuple):
    """Steps that are learnt from at once.

    Attributes:
        states: observations, of B rows.
        actions: shape (B,).
        log_probs: of the actions when they were taken, shape (B,).
        advantages: shape (B,).
        returns: what the values are to be, shape (B,).
        values: what they were, shape (B,).
    """

    states: Inputs
    actions: Ints
    log_probs: Singles
    advantages: Singles
    returns: Singles
    values: Singles


@kernel
def learn_from_rollout_minibatch(learner: Any, n_rows: float, learning_rate: float) -> int:
    """Take one step of gradient descent on the first ``n_rows`` rows of `learner.batch`.

    Args:
        learner: both networks, the optimizer and the minibatch.
        n_rows: number of rows.
        learning_rate: of the optimizer.

    Returns:
        0 where the policy has moved too far already, and nothing was done; otherwise 1.
    """
    batch, rules, losses = learner.batch, learner.rules[0], learner.losses[0]
    n = int(n_rows)
    if rules.normalize_advantage and n > 1:
        standardize(batch.advantages[:n])
    states = batch.states
    forward(learner.policy, learner.flat, states, n, learner.policy_outputs)
    forward(learner.value, learner.flat, states, n, learner.value_outputs)
    _policy_errors(learner, n, learner.place[0].clip_range)
    _value_errors(learner, n, learner.place[0].clip_range_vf)
    losses.total = (
        losses.policy_gradient + rules.ent_coef * losses.entropy + rules.vf_coef * losses.value
    )
    if losses.kl > 1.5 * rules.target_kl:
        return 0
    for layers, outputs, errors in (
        (learner.policy, learner.policy_outputs, learner.policy_errors),
        (learner.value, learner.value_outputs, learner.value_errors),
    ):
        backward(layers, learner.flat, states, n, outputs, errors, learner.gradient)
    descend(learner.optimizer, learner.flat, learner.gradient, learning_rate, rules.max_grad_norm)
    return 1


@called
def standardize(numbers: Singles) -> None:
    """Give them mean 0 and standard deviation 1, as far as they have one."""
    n = len(numbers)
    mean = squares = 0.0
    for i in range(n):
        mean += numbers[i]
    mean /= n
    for i in range(n):
        squares += (numbers[i] - mean) ** 2
    scale = 1.0 / (math.sqrt(squares / (n - 1)) + 1e-8)
    for i in range(n):
        numbers[i] = np.float32((numbers[i] - mean) * scale)


@called
def _policy_errors(learner: Any, n: int, clip_range: float) -> None:
    """Write the loss's derivatives by the logits, and note what the policy adds to it."""
    batch, losses = learner.batch, learner.losses[0]
    logits = last_outputs(learner.policy, learner.policy_outputs, n)
    slopes = last_outputs(learner.policy, learner.policy_errors, n)
    losses.policy_gradient = losses.likelihood = losses.entropy = 0.0
    losses.kl = losses.clipped = 0.0
    by_entropy = -learner.rules[0].ent_coef / n
    for i in range(n):
        row, action, advantage = logits[i], batch.actions[i], float(batch.advantages[i])
        normalizer = log_normalizer(row)
        log_prob = float(row[action]) - normalizer
        log_ratio = log_prob - batch.log_probs[i]
        ratio = math.exp(log_ratio)
        bounded = min(max(ratio, 1 - clip_range), 1 + clip_range)
        gain = min(advantage * ratio, advantage * bounded)
        # Past its bound a ratio counts no further, unless it has to come back.
        moves = ratio == bounded or advantage * ratio < advantage * bounded
        by_log = -advantage * ratio / n if moves else 0.0
        entropy = fill_probabilities(row, normalizer, slopes[i])
        turn_into_slopes(slopes[i], row, normalizer, entropy, action, by_log, by_entropy)
        losses.policy_gradient -= gain / n
        losses.likelihood -= advantage * log_prob / n
        losses.entropy -= entropy / n
        losses.kl += (ratio - 1 - log_ratio) / n
        losses.clipped += (1.0 / n) if abs(ratio - 1) > clip_range else 0.0


@called
def _value_errors(learner: Any, n: int, clip_range_vf: float) -> None:
    """Write the loss's derivatives by the values, and note what these add to it."""
    batch, losses = learner.batch, learner.losses[0]
    values = last_outputs(learner.value, learner.value_outputs, n)
    slopes = last_outputs(learner.value, learner.value_errors, n)
    losses.value = 0.0
    factor = 2 * learner.rules[0].vf_coef / n
    for i in range(n):
        moved = float(values[i, 0]) - batch.values[i]
        predicted = batch.values[i] + min(max(moved, -clip_range_vf), clip_range_vf)
        error = predicted - batch.returns[i]
        slopes[i, 0] = np.float32(factor * error) if abs(moved) <= clip_range_vf else np.float32(0)
        losses.value += error * error / n
