"""Steps of gradient descent as PyTorch's optimizers take them, on flat vectors.

Sources: Kingma and Ba (2015) for Adam, Loshchilov and Hutter (2019) for AdamW; Tieleman and Hinton
(2012) for RMSprop, with TensorFlow's place of epsilon as Stable-Baselines3 has it; Pascanu, Mikolov
and Bengio (2013) for clipping.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agents.networks.matrix_products import Singles
from machine_code.compiling import vectorised

ADAM, ADAMW, RMSPROP, RMSPROP_TENSORFLOW = range(4)

# Moments of units that are dead would come so close to zero that processors take a hundred cycles
# for each operation on them. What lies below counts as zero; what is not a number stays that.
_TINY, _TINY_SQUARE = np.float32(1e-17), np.float32(1e-36)
_ZERO, _ONE = np.float32(0), np.float32(1)


class Optimizer(NamedTuple):
    """An optimizer and what it remembers.

    Attributes:
        kind: `ADAM`, `ADAMW`, `RMSPROP` or `RMSPROP_TENSORFLOW`.
        momentum: Adam's beta_1.
        smoothing: Adam's beta_2, RMSprop's alpha.
        epsilon: keeps divisors from zero.
        weight_decay: how much parameters are drawn to zero: by a part of the gradient, or with
            `ADAMW` beside it.
        mean: running mean of gradients, as long as the parameters.
        mean_square: of their squares.
        n_steps: steps taken so far, alone in an array, in single precision as PyTorch has it.
    """

    kind: int
    momentum: float
    smoothing: float
    epsilon: float
    weight_decay: float
    mean: Singles
    mean_square: Singles
    n_steps: Singles


@vectorised
def descend(
    optimizer: Optimizer,
    flat: Singles,
    gradient: Singles,
    learning_rate: float,
    max_grad_norm: float,
) -> None:
    """Take one step against the gradient, whose norm is clipped first."""
    scale = _clipping(gradient, max_grad_norm)
    optimizer.n_steps[0] += np.float32(1)
    if optimizer.kind <= ADAMW:
        _adam(optimizer, flat, gradient, scale, learning_rate)
    else:
        _rmsprop(optimizer, flat, gradient, scale, learning_rate)


@vectorised
def _clipping(gradient: Singles, max_grad_norm: float) -> Any:
    """What gradients are multiplied by, as ``torch.nn.utils.clip_grad_norm_`` has it."""
    total = _ZERO
    for i in range(len(gradient)):
        total += gradient[i] * gradient[i]
    scale = max_grad_norm / (math.sqrt(total) + 1e-6)
    return _ONE if scale >= 1.0 else np.float32(scale)


@vectorised
def _adam(
    optimizer: Optimizer, flat: Singles, gradient: Singles, scale: Any, learning_rate: float
) -> None:
    n_steps = float(optimizer.n_steps[0])
    rate = np.float32(1 - optimizer.momentum)
    kept, square_rate = np.float32(optimizer.smoothing), np.float32(1 - optimizer.smoothing)
    step_size = np.float32(learning_rate / (1 - optimizer.momentum**n_steps))
    correction = np.float32(1 / math.sqrt(1 - optimizer.smoothing**n_steps))
    epsilon = np.float32(optimizer.epsilon)
    decay = np.float32(optimizer.weight_decay if optimizer.kind == ADAM else 0.0)
    beside = learning_rate * optimizer.weight_decay if optimizer.kind == ADAMW else 0.0
    left = np.float32(1 - beside)
    mean, mean_square = optimizer.mean, optimizer.mean_square
    for i in range(len(flat)):
        slope = gradient[i] * scale + decay * flat[i]
        slope = _ZERO if abs(slope) <= _TINY else slope
        first = mean[i] + (slope - mean[i]) * rate
        first = _ZERO if abs(first) <= _TINY else first
        second = mean_square[i] * kept + slope * slope * square_rate
        second = _ZERO if second <= _TINY_SQUARE else second
        mean[i], mean_square[i] = first, second
        flat[i] = left * flat[i] - step_size * first / (np.sqrt(second) * correction + epsilon)


@vectorised
def _rmsprop(
    optimizer: Optimizer, flat: Singles, gradient: Singles, scale: Any, learning_rate: float
) -> None:
    kept, square_rate = np.float32(optimizer.smoothing), np.float32(1 - optimizer.smoothing)
    inside = np.float32(optimizer.epsilon if optimizer.kind == RMSPROP_TENSORFLOW else 0.0)
    outside = np.float32(0.0 if optimizer.kind == RMSPROP_TENSORFLOW else optimizer.epsilon)
    step_size, decay = np.float32(learning_rate), np.float32(optimizer.weight_decay)
    mean_square = optimizer.mean_square
    for i in range(len(flat)):
        slope = gradient[i] * scale + decay * flat[i]
        slope = _ZERO if abs(slope) <= _TINY else slope
        second = mean_square[i] * kept + slope * slope * square_rate
        second = _ZERO if second <= _TINY_SQUARE else second
        mean_square[i] = second
        flat[i] -= step_size * slope / (np.sqrt(second + inside) + outside)
