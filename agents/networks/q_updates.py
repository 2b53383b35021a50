"""One step of deep Q-learning on a minibatch.

Sources: Mnih et al. (2013 and 2015), van Hasselt, Guez and Silver (2016).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from agents.networks.matrix_products import Singles
from agents.networks.optimizers import descend
from agents.networks.perceptron import backward, forward, last_outputs
from machine_code.compiling import called, inlined, kernel

# What the value of the next state is taken from.
TARGET_NETWORK, DOUBLE, ONLINE_NETWORK = range(3)


@inlined
def best_of(values: Any) -> int:
    """The first of the largest."""
    best = 0
    for k in range(1, len(values)):
        if values[k] > values[best]:
            best = k
    return best


@kernel
def learn_from_minibatch(learner: Any, learning_rate: float, _: float) -> int:
    """Take one step of gradient descent on `learner.batch`.

    The loss before it is added to ``place.losses``: Huber's, or half the squared error.

    Args:
        learner: both networks, the optimizer and the minibatch.
        learning_rate: of the optimizer.
        _: nothing; what is called by its address takes two numbers, whoever learns.

    Returns:
        The number of rows.
    """
    layers, batch, rules = learner.layers, learner.batch, learner.rules[0]
    n = len(batch.actions)
    lagging = learner.flat if rules.target_kind == ONLINE_NETWORK else learner.target
    forward(layers, lagging, batch.next_states, n, learner.next_outputs)
    next_values = last_outputs(layers, learner.next_outputs, n)
    preferred = next_values
    if rules.target_kind == DOUBLE:
        # Overwritten below, once the choice has been made.
        forward(layers, learner.flat, batch.next_states, n, learner.outputs)
        preferred = last_outputs(layers, learner.outputs, n)
    for i in range(n):
        batch.rewards[i] += batch.discounts[i] * next_values[i, best_of(preferred[i])]
    forward(layers, learner.flat, batch.states, n, learner.outputs)
    learner.place[0].losses += _errors(learner, n, rules.largest_error)
    backward(
        layers,
        learner.flat,
        batch.states,
        n,
        learner.outputs,
        learner.errors,
        learner.gradient,
    )
    descend(learner.optimizer, learner.flat, learner.gradient, learning_rate, rules.max_grad_norm)
    return n


@called
def _errors(learner: Any, n: int, largest: float) -> float:
    """Write the loss's derivatives by the values, given targets in ``batch.rewards``."""
    batch = learner.batch
    values = last_outputs(learner.layers, learner.outputs, n)
    errors = last_outputs(learner.layers, learner.errors, n)
    errors[:] = 0
    loss = 0.0
    for i in range(n):
        error = float(values[i, batch.actions[i]] - batch.rewards[i])
        slope = min(max(error, -largest), largest)
        errors[i, batch.actions[i]] = np.float32(slope / n)
        # Half the square up to the largest slope, and a straight line from there on.
        loss += slope * (error - slope / 2)
    return loss / n


@called
def follow(target: Singles, flat: Singles, tau: float) -> None:
    """Move the target network towards the one that learns, by the share ``tau``."""
    for i in range(len(flat)):
        target[i] = target[i] * np.float32(1 - tau) + np.float32(tau) * flat[i]
