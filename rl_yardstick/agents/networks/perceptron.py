"""A multilayer perceptron, its gradient and its optimizers, on flat vectors in single precision."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.np.linalg import _BLAS, ensure_blas
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from rl_yardstick.machine_code.compiling import internal, vectorised, view
from rl_yardstick.mdp.transition_model import Ints

# Products of matrices in single precision, by the routine of SciPy's BLAS that is behind Numba's
# `numpy.dot`. That function counts references, which compiled loops here avoid. BLAS stores
# matrices by columns, so it gets the transposed problem: the rows of a matrix are its columns.

Singles = NDArray[np.float32]

SINGLE, AS_IT_IS, TRANSPOSED = map(ord, "sNT")
_gemm: Any = _BLAS.numba_xxgemm(types.float32)  # type: ignore[no-untyped-call]
# The factors of the product, and of the earlier content of its array.
_FACTOR, _ADDED = np.ones(1, np.float32), np.zeros(1, np.float32)

_controller = cache(ThreadpoolController)  # made when SciPy's BLAS is loaded


def one_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread within a ``with`` statement.

    The matrices are too small for several threads, whose number would change the last bits.
    """
    ensure_blas()  # type: ignore[no-untyped-call]
    limited: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limited


@internal
def multiply(
    left: Singles, left_kind: int, right: Singles, right_kind: int, product: Singles
) -> None:
    """The product of two matrices, each `AS_IT_IS` or `TRANSPOSED`."""
    m, n = product.shape
    inner = left.shape[1] if left_kind == AS_IT_IS else left.shape[0]
    _gemm(
        SINGLE,
        right_kind,
        left_kind,
        n,
        m,
        inner,
        _FACTOR.ctypes,
        right.ctypes,
        right.shape[1],
        left.ctypes,
        left.shape[1],
        _ADDED.ctypes,
        product.ctypes,
        n,
    )


# Activation functions in single precision, and their derivatives as functions of the outputs.

IDENTITY, RELU, TANH = range(3)

# Coefficients of a rational function of x squared, from the highest power on, from Eigen's
# `generic_fast_tanh_float`: within a few units in the last place, and without a function call, so
# that it can be vectorised.
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
    # nan stays nan.
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
def activate(rows: Singles, bias: Singles, kind: int) -> None:
    """Add the bias to each row, shape (n, d), and apply the activation function ``kind``."""
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
                row[j] += bias[j]


@vectorised
def pull_back(errors: Singles, outputs: Singles, kind: int) -> None:
    """Turn derivatives by outputs into derivatives by inputs, in place, shape (n, d)."""
    for i in range(len(errors)):
        error, output = errors[i], outputs[i]
        if kind == RELU:
            for j in range(len(error)):
                error[j] = error[j] if output[j] > _ZERO else _ZERO
        elif kind == TANH:
            for j in range(len(error)):
                error[j] *= _ONE - output[j] * output[j]


# A multilayer perceptron and its gradient, with all parameters in one flat vector.
#
# Weights of a layer are stored as (inputs, outputs), the transpose of PyTorch's, so that a one-hot
# input only reads one row. The outputs of all layers are in one array, one layer after the other,
# so that training allocates nothing.
#
# Source: Goodfellow, Bengio and Courville, Deep Learning (2016), algorithms 6.3 and 6.4.


class Layers(NamedTuple):
    """The shape of a perceptron of L layers."""

    sizes: Ints  # number of inputs, then of outputs of each layer, shape (L + 1,)
    weights_at: Ints  # start of each layer's weights in the flat vector, shape (L,)
    biases_at: Ints  # start of each layer's biases, shape (L,)
    outputs_at: Ints  # start of each layer's outputs in an array of outputs, per row, shape (L,)
    activation: int  # after each layer but the last: `IDENTITY`, `RELU` or `TANH`
    one_hot: int  # 1 if inputs are indices of one-hot vectors, else 0


class Inputs(NamedTuple):
    """Input rows of a perceptron."""

    vectors: Singles  # shape (n, sizes[0]); not read with one-hot inputs
    indices: Ints  # of one-hot vectors, shape (n,)


def make_inputs(layers: Layers, n: int) -> Inputs:
    """A buffer for ``n`` input rows."""
    width = 1 if layers.one_hot else int(layers.sizes[0])
    return Inputs(np.zeros((n, width), np.float32), np.zeros(n, np.int64))


def make_layers(sizes: Sequence[int], start: int, activation: int, *, one_hot: bool) -> Layers:
    """The shape of a perceptron whose parameters begin at ``start`` of the flat vector."""
    inputs, outputs = np.array(sizes[:-1], np.int64), np.array(sizes[1:], np.int64)
    ends = start + np.cumsum(inputs * outputs + outputs)
    return Layers(
        np.array(sizes, np.int64),
        ends - outputs - inputs * outputs,
        ends - outputs,
        np.cumsum(outputs) - outputs,
        activation,
        int(one_hot),
    )


def n_parameters(layers: Layers) -> int:
    """The number of the perceptron's parameters in the flat vector."""
    return int(np.sum((layers.sizes[:-1] + 1) * layers.sizes[1:]))


def make_outputs(layers: Layers, n: int) -> Singles:
    """A buffer for the outputs of all layers for ``n`` rows."""
    return np.zeros(n * int(layers.sizes[1:].sum()), np.float32)


@view
def weights_of(layers: Layers, flat: Singles, layer: int) -> Singles:
    """A view of the weights of a layer in the flat vector, shape (inputs, outputs)."""
    n_in, n_out = layers.sizes[layer], layers.sizes[layer + 1]
    begin = layers.weights_at[layer]
    return flat[begin : begin + n_in * n_out].reshape((n_in, n_out))


@view
def biases_of(layers: Layers, flat: Singles, layer: int) -> Singles:
    """A view of the biases of a layer, shape (outputs,)."""
    begin = layers.biases_at[layer]
    return flat[begin : begin + layers.sizes[layer + 1]]


@view
def outputs_of(layers: Layers, outputs: Singles, layer: int, n: int) -> Singles:
    """A view of the outputs of a layer for ``n`` rows, shape (n, outputs)."""
    width = layers.sizes[layer + 1]
    begin = n * layers.outputs_at[layer]
    return outputs[begin : begin + n * width].reshape((n, width))


@view
def last_outputs(layers: Layers, outputs: Singles, n: int) -> Singles:
    """A view of the perceptron's outputs for ``n`` rows, shape (n, sizes[-1])."""
    return outputs_of(layers, outputs, len(layers.sizes) - 2, n)


@vectorised
def forward(layers: Layers, flat: Singles, inputs: Inputs, n: int, outputs: Singles) -> None:
    """Evaluate the perceptron on the first ``n`` rows; `last_outputs` returns the result."""
    below = inputs.vectors[:n]
    n_layers = len(layers.sizes) - 1
    for layer in range(n_layers):
        weights, bias = weights_of(layers, flat, layer), biases_of(layers, flat, layer)
        above = outputs_of(layers, outputs, layer, n)
        if layer == 0 and layers.one_hot:
            _pick_rows(weights, inputs.indices, above)
        else:
            multiply(below, AS_IT_IS, weights, AS_IT_IS, above)
        activate(above, bias, layers.activation if layer < n_layers - 1 else IDENTITY)
        below = above


@vectorised
def _pick_rows(rows: Singles, indices: Ints, picked: Singles) -> None:
    for i in range(len(picked)):
        row, to = rows[indices[i]], picked[i]
        for j in range(len(to)):
            to[j] = row[j]


@vectorised
def backward(
    layers: Layers,
    flat: Singles,
    inputs: Inputs,
    n: int,
    outputs: Singles,
    errors: Singles,
    gradient: Singles,
) -> None:
    """Write the gradient, from the outputs of `forward` and the derivatives by the last outputs.

    The derivatives are `last_outputs` of ``errors``; the rest of ``errors`` is scratch.
    """
    for layer in range(len(layers.sizes) - 2, -1, -1):
        error = outputs_of(layers, errors, layer, n)
        _sum_rows(error, biases_of(layers, gradient, layer))
        slot = weights_of(layers, gradient, layer)
        if layer == 0:
            if layers.one_hot:
                _add_rows(error, inputs.indices, slot)
            else:
                multiply(inputs.vectors[:n], TRANSPOSED, error, AS_IT_IS, slot)
            return
        below = outputs_of(layers, outputs, layer - 1, n)
        error_below = outputs_of(layers, errors, layer - 1, n)
        weights = weights_of(layers, flat, layer)
        multiply(below, TRANSPOSED, error, AS_IT_IS, slot)
        multiply(error, AS_IT_IS, weights, TRANSPOSED, error_below)
        pull_back(error_below, below, layers.activation)


@vectorised
def _sum_rows(rows: Singles, total: Singles) -> None:
    total[:] = 0
    for i in range(len(rows)):
        row = rows[i]
        for j in range(len(total)):
            total[j] += row[j]


@vectorised
def _add_rows(rows: Singles, indices: Ints, totals: Singles) -> None:
    """Set ``totals`` to zero, then add each row to the total of its index."""
    totals[:] = 0
    for i in range(len(rows)):
        row, total = rows[i], totals[indices[i]]
        for j in range(len(row)):
            total[j] += row[j]


# The steps of PyTorch's optimizers, on flat vectors.
#
# Sources: Kingma and Ba (2015) for Adam, Loshchilov and Hutter (2019) for AdamW; Tieleman and
# Hinton (2012) for RMSprop, also with epsilon as in TensorFlow and Stable-Baselines3; Pascanu,
# Mikolov and Bengio (2013) for clipping.

ADAM, ADAMW, RMSPROP, RMSPROP_TENSORFLOW = range(4)

# Moments of dead units would become subnormal numbers, on which operations take a hundred cycles.
# Magnitudes below these count as zero; nan stays nan.
_TINY, _TINY_SQUARE = np.float32(1e-17), np.float32(1e-36)


class Optimizer(NamedTuple):
    """An optimizer and its state."""

    kind: int  # `ADAM`, `ADAMW`, `RMSPROP` or `RMSPROP_TENSORFLOW`
    momentum: float  # Adam's beta_1
    smoothing: float  # Adam's beta_2, RMSprop's alpha
    epsilon: float  # keeps divisors from zero
    weight_decay: float  # added to the gradient, or decoupled from it with `ADAMW`
    mean: Singles  # running mean of gradients, as long as the parameters
    mean_square: Singles  # running mean of their squares
    n_steps: Singles  # steps so far, shape (1,), in single precision as in PyTorch


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
    """The factor by which ``torch.nn.utils.clip_grad_norm_`` scales the gradient."""
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
