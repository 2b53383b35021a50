"""Activation functions in single precision, and their derivatives.

All of these have a derivative that can be told from the output alone, so that inputs need not be
kept.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.networks.matrix_products import Singles
from mdp.machine_code import internal, vectorised

IDENTITY, RELU, TANH, ELU, LEAKY_RELU, SIGMOID = range(6)

# Coefficients of a rational function of x squared, from the highest power on, as Eigen's
# `generic_fast_tanh_float` has them: within a few units in the last place, and without a call, so
# that many numbers are worked out at once.
_NUMERATOR = (
    np.float32(-2.76076847742355e-16),
    np.float32(2.00018790482477e-13),
    np.float32(-8.60467152213735e-11),
    np.float32(5.12229709037114e-08),
    np.float32(1.48572235717979e-05),
    np.float32(6.37261928875436e-04),
    np.float32(4.89352455891786e-03),
)
_DENOMINATOR = (
    np.float32(1.19825839466702e-06),
    np.float32(1.18534705686654e-04),
    np.float32(2.26843463243900e-03),
    np.float32(4.89352518554385e-03),
)
# From here on the hyperbolic tangent is 1 in single precision.
_BOUND = np.float32(7.90531110763549805)
_ZERO, _ONE = np.float32(0), np.float32(1)


@internal
def tanh(x: Any) -> Any:
    """The hyperbolic tangent of a single-precision number."""
    # What is not a number stays that.
    x = _BOUND if x > _BOUND else x
    x = -_BOUND if x < -_BOUND else x
    square = x * x
    top, bottom = _NUMERATOR[0], _DENOMINATOR[0]
    for coefficient in _NUMERATOR[1:]:
        top = top * square + coefficient
    for coefficient in _DENOMINATOR[1:]:
        bottom = bottom * square + coefficient
    return x * top / bottom


@vectorised
def activate(rows: Singles, bias: Singles, kind: int, slope: Any) -> None:
    """Add the bias to each row, shape (n, d), and apply the function of that kind."""
    for i in range(len(rows)):
        row = rows[i]
        if kind == RELU:
            for j in range(len(row)):
                x = row[j] + bias[j]
                row[j] = _ZERO if x < _ZERO else x
        elif kind == TANH:
            for j in range(len(row)):
                row[j] = tanh(row[j] + bias[j])
        else:
            for j in range(len(row)):
                row[j] = _one_by_one(row[j] + bias[j], kind, slope)


@internal
def _one_by_one(x: Any, kind: int, slope: Any) -> Any:
    if kind == ELU:
        return x if x > _ZERO else slope * np.float32(math.expm1(x))
    if kind == LEAKY_RELU:
        return x if x > _ZERO else slope * x
    if kind == SIGMOID:
        return np.float32(1 / (1 + math.exp(-x)))
    return x


@vectorised
def pull_back(errors: Singles, outputs: Singles, kind: int, slope: Any) -> None:
    """Turn derivatives by the outputs into those by the inputs, in place; both of shape (n, d)."""
    for i in range(len(errors)):
        error, output = errors[i], outputs[i]
        if kind == RELU:
            for j in range(len(error)):
                error[j] = error[j] if output[j] > _ZERO else _ZERO
        elif kind == TANH:
            for j in range(len(error)):
                error[j] *= _ONE - output[j] * output[j]
        else:
            for j in range(len(error)):
                error[j] *= _derivative(output[j], kind, slope)


@internal
def _derivative(output: Any, kind: int, slope: Any) -> Any:
    if kind == ELU:
        return _ONE if output > _ZERO else output + slope
    if kind == LEAKY_RELU:
        return _ONE if output > _ZERO else slope
    if kind == SIGMOID:
        return output * (_ONE - output)
    return _ONE
