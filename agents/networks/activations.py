"""Activation functions in single precision, and their derivatives.

Those of the first can be told from the output alone. Of the others inputs are kept.

Sources: Clevert, Unterthiner and Hochreiter (2016) for ELU, Klambauer et al. (2017) for SELU,
Hendrycks and Gimpel (2016) for GELU and SiLU, Misra (2020) for Mish.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.networks.matrix_products import Singles
from machine_code.compiling import called, internal, vectorised

IDENTITY, RELU, TANH, ELU, LEAKY_RELU, SIGMOID = range(6)
SELU, SOFTPLUS, SILU, GELU, FAST_GELU, MISH = range(6, 12)

# From here on inputs are kept for the derivative.
FIRST_BY_INPUT = SELU

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

_SELU_SCALE, _SELU_ALPHA = 1.0507009873554805, 1.6732632423543772
_SQRT_HALF, _SQRT_PI = math.sqrt(0.5), math.sqrt(math.pi)
# Of GELU's approximation, 0.5 (1 + tanh(u)) being sigmoid(2 u).
_GELU_SCALE, _GELU_CUBE = math.sqrt(2 / math.pi), 0.044715


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


# Those of the other kinds are rare: by functions of their own, which are called for each number,
# they add little to what has to be compiled.


@called
def activate_kept(
    inputs: Singles, bias: Singles, outputs: Singles, kind: int, slope: float
) -> None:
    """As `activate`, of a function from `FIRST_BY_INPUT` on; ``inputs`` keep what it is given."""
    for i in range(len(inputs)):
        row, to = inputs[i], outputs[i]
        for j in range(len(row)):
            row[j] += bias[j]
            to[j] = np.float32(_by_input(float(row[j]), kind, slope))


@called
def _by_input(x: float, kind: int, slope: float) -> float:
    if kind == SELU:
        return _SELU_SCALE * (x if x > 0 else _SELU_ALPHA * math.expm1(x))
    if kind == SOFTPLUS:
        return _softplus(x * slope) / slope
    if kind == SILU:
        return x * _sigmoid(x)
    if kind == GELU:
        return x * _normal_probability(x)
    if kind == FAST_GELU:
        return x * _sigmoid(2 * _GELU_SCALE * (x + _GELU_CUBE * x**3))
    return x * math.tanh(_softplus(x))


@internal
def _sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@internal
def _softplus(x: float) -> float:
    """Logarithm of 1 + exp(x), without running over."""
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


@internal
def _normal_probability(x: float) -> float:
    """That a standard normal number is below."""
    return 0.5 * math.erfc(-x * _SQRT_HALF)


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


@called
def pull_back_kept(errors: Singles, inputs: Singles, kind: int, slope: float) -> None:
    """As `pull_back`, of a function from `FIRST_BY_INPUT` on."""
    for i in range(len(errors)):
        error, row = errors[i], inputs[i]
        for j in range(len(error)):
            error[j] *= np.float32(_derivative_by_input(float(row[j]), kind, slope))


@called
def _derivative_by_input(x: float, kind: int, slope: float) -> float:
    if kind == SELU:
        return _SELU_SCALE * (1.0 if x > 0 else _SELU_ALPHA * math.exp(x))
    if kind == SOFTPLUS:
        return _sigmoid(x * slope)
    if kind == SILU:
        share = _sigmoid(x)
        return share * (1 + x * (1 - share))
    if kind == GELU:
        density = math.exp(-0.5 * x * x) * _SQRT_HALF / _SQRT_PI
        return _normal_probability(x) + x * density
    if kind == FAST_GELU:
        share = _sigmoid(2 * _GELU_SCALE * (x + _GELU_CUBE * x**3))
        inner = 2 * _GELU_SCALE * (1 + 3 * _GELU_CUBE * x * x)
        return share * (1 + x * (1 - share) * inner)
    gate = math.tanh(_softplus(x))
    return gate + x * (1 - gate * gate) * _sigmoid(x)
