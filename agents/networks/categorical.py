"""The softmax distribution over actions that a network's outputs stand for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.networks.matrix_products import Singles
from machine_code.compiling import inlined


@inlined
def log_normalizer(logits: Singles) -> float:
    """Logarithm of the sum of exponentials, shape (n,) in."""
    top = logits[0]
    for k in range(1, len(logits)):
        top = max(top, logits[k])
    total = 0.0
    for k in range(len(logits)):
        total += math.exp(float(logits[k] - top))
    return float(top) + math.log(total)


@inlined
def draw(logits: Singles, uniform: float) -> int:
    """The action that a number in [0, 1) picks."""
    normalizer, cumulative = log_normalizer(logits), 0.0
    for k in range(len(logits) - 1):
        cumulative += math.exp(float(logits[k]) - normalizer)
        if uniform < cumulative:
            return k
    return len(logits) - 1


@inlined
def log_probability(logits: Singles, action: int) -> float:
    """Of an action."""
    return float(logits[action]) - log_normalizer(logits)


@inlined
def fill_probabilities(logits: Singles, normalizer: float, probabilities: Any) -> float:
    """Work out all probabilities, shape (n,); the entropy in nats is returned."""
    entropy = 0.0
    for k in range(len(logits)):
        logarithm = float(logits[k]) - normalizer
        probability = math.exp(logarithm)
        entropy -= probability * logarithm
        probabilities[k] = np.float32(probability)
    return entropy


@inlined
def turn_into_slopes(
    probabilities: Any,
    logits: Singles,
    normalizer: float,
    entropy: float,
    action: int,
    by_log: float,
    by_entropy: float,
) -> None:
    """Derivatives by the logits of what depends on them in two ways, in place of probabilities.

    Args:
        probabilities: what `fill_probabilities` has left, shape (n,).
        logits: the outputs of the network.
        normalizer: their `log_normalizer`.
        entropy: of the distribution.
        action: the action taken.
        by_log: derivative by the logarithm of its probability.
        by_entropy: derivative by the entropy.
    """
    for k in range(len(logits)):
        probability = float(probabilities[k])
        surplus = float(logits[k]) - normalizer + entropy
        slope = -probability * (by_log + by_entropy * surplus)
        probabilities[k] = np.float32(slope + by_log if k == action else slope)
