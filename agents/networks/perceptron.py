"""A multilayer perceptron and its gradient, with all parameters in one flat vector.

Weights of a layer lie as (inputs, outputs), the transpose of PyTorch's: of an input that is one-hot
a row is all that has to be read. What layers put out lies in one array as well, a layer after the
other, so that nothing is allocated while training; behind it what activation functions were given,
where their derivatives ask for that.

Source: Goodfellow, Bengio and Courville, Deep Learning (2016), algorithms 6.3 and 6.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agents.networks.activations import (
    FIRST_BY_INPUT,
    IDENTITY,
    activate,
    activate_kept,
    pull_back,
    pull_back_kept,
)
from agents.networks.matrix_products import (
    Singles,
    multiply,
    multiply_transposed_left,
    multiply_transposed_right,
    sgemm_address,
)
from machine_code.compiling import vectorised, view
from mdp.array_types import Ints


class Layers(NamedTuple):
    """The shape of a perceptron of L layers.

    Attributes:
        sizes: number of inputs, then of outputs of each layer, shape (L + 1,).
        weights_at: where the weights of each layer begin in the flat vector, shape (L,).
        biases_at: where its biases do, shape (L,).
        outputs_at: where its outputs begin in an array of outputs, for each row, shape (L,).
        activation: what follows each layer but the last, of `agents.networks.activations`.
        slope: the one parameter of that function, where it has one.
        one_hot: 1 where inputs are numbers that stand for one-hot vectors.
        sgemm: the address of BLAS's routine.
    """

    sizes: Ints
    weights_at: Ints
    biases_at: Ints
    outputs_at: Ints
    activation: int
    slope: float
    one_hot: int
    sgemm: np.uintp


class Inputs(NamedTuple):
    """Rows that a perceptron is evaluated on.

    Attributes:
        vectors: shape (n, sizes[0]); not read with one-hot inputs.
        indices: the numbers that stand for one-hot vectors, shape (n,).
    """

    vectors: Singles
    indices: Ints


def make_inputs(layers: Layers, n: int) -> Inputs:
    """Room for ``n`` rows."""
    width = 1 if layers.one_hot else int(layers.sizes[0])
    return Inputs(np.zeros((n, width), np.float32), np.zeros(n, np.int64))


def make_layers(
    sizes: Sequence[int], start: int, activation: int, slope: float, *, one_hot: bool
) -> Layers:
    """The shape of a perceptron whose parameters begin at ``start`` of the flat vector."""
    inputs, outputs = np.array(sizes[:-1], np.int64), np.array(sizes[1:], np.int64)
    ends = start + np.cumsum(inputs * outputs + outputs)
    return Layers(
        np.array(sizes, np.int64),
        ends - outputs - inputs * outputs,
        ends - outputs,
        np.cumsum(outputs) - outputs,
        activation,
        float(slope),
        int(one_hot),
        sgemm_address(),
    )


def n_parameters(layers: Layers) -> int:
    """How many numbers the perceptron takes in the flat vector."""
    return int(np.sum((layers.sizes[:-1] + 1) * layers.sizes[1:]))


def make_outputs(layers: Layers, n: int) -> Singles:
    """Room for all that the layers put out for ``n`` rows, and for what functions are given."""
    n_kept = 2 if layers.activation >= FIRST_BY_INPUT else 1
    return np.zeros(n * n_kept * int(layers.sizes[1:].sum()), np.float32)


@view
def weights_of(layers: Layers, flat: Singles, layer: int) -> Singles:
    """The weights of a layer, shape (inputs, outputs), in the memory of the flat vector."""
    n_in, n_out = layers.sizes[layer], layers.sizes[layer + 1]
    begin = layers.weights_at[layer]
    return flat[begin : begin + n_in * n_out].reshape((n_in, n_out))


@view
def biases_of(layers: Layers, flat: Singles, layer: int) -> Singles:
    """The biases of a layer, shape (outputs,)."""
    begin = layers.biases_at[layer]
    return flat[begin : begin + layers.sizes[layer + 1]]


@view
def outputs_of(layers: Layers, outputs: Singles, layer: int, n: int) -> Singles:
    """What a layer puts out for ``n`` rows, shape (n, outputs)."""
    width = layers.sizes[layer + 1]
    begin = n * layers.outputs_at[layer]
    return outputs[begin : begin + n * width].reshape((n, width))


@view
def kept_inputs_of(layers: Layers, outputs: Singles, layer: int, n: int) -> Singles:
    """What a layer's activation function is given for ``n`` rows, shape (n, outputs)."""
    width = layers.sizes[layer + 1]
    begin = n * (layers.outputs_at[-1] + layers.sizes[-1] + layers.outputs_at[layer])
    return outputs[begin : begin + n * width].reshape((n, width))


@view
def last_outputs(layers: Layers, outputs: Singles, n: int) -> Singles:
    """What the perceptron puts out for ``n`` rows, shape (n, sizes[-1])."""
    return outputs_of(layers, outputs, len(layers.sizes) - 2, n)


@vectorised
def forward(layers: Layers, flat: Singles, inputs: Inputs, n: int, outputs: Singles) -> None:
    """Evaluate the perceptron on the first ``n`` rows; `last_outputs` has what comes out."""
    below = inputs.vectors[:n]
    n_layers = len(layers.sizes) - 1
    for layer in range(n_layers):
        weights, bias = weights_of(layers, flat, layer), biases_of(layers, flat, layer)
        above = outputs_of(layers, outputs, layer, n)
        kind = layers.activation if layer < n_layers - 1 else IDENTITY
        product = above
        if kind >= FIRST_BY_INPUT:
            product = kept_inputs_of(layers, outputs, layer, n)
        if layer == 0 and layers.one_hot:
            _pick_rows(weights, inputs.indices, product)
        else:
            multiply(layers.sgemm, below, weights, product)
        if kind >= FIRST_BY_INPUT:
            activate_kept(product, bias, above, kind, layers.slope)
        else:
            activate(above, bias, kind, np.float32(layers.slope))
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
    """The gradient by all parameters, from the derivatives by the perceptron's outputs.

    Args:
        layers: the shape.
        flat: the parameters.
        inputs: what `forward` was given.
        n: the number of rows.
        outputs: what `forward` has left.
        errors: as long; `last_outputs` of it are the derivatives, the rest is for work.
        gradient: where to write, as long as the parameters.
    """
    for layer in range(len(layers.sizes) - 2, -1, -1):
        error = outputs_of(layers, errors, layer, n)
        _sum_rows(error, biases_of(layers, gradient, layer))
        slot = weights_of(layers, gradient, layer)
        if layer == 0:
            if layers.one_hot:
                _add_rows(error, inputs.indices, slot)
            else:
                multiply_transposed_left(layers.sgemm, inputs.vectors[:n], error, slot)
            return
        below = outputs_of(layers, outputs, layer - 1, n)
        error_below = outputs_of(layers, errors, layer - 1, n)
        multiply_transposed_left(layers.sgemm, below, error, slot)
        multiply_transposed_right(layers.sgemm, error, weights_of(layers, flat, layer), error_below)
        if layers.activation >= FIRST_BY_INPUT:
            kept = kept_inputs_of(layers, outputs, layer - 1, n)
            pull_back_kept(error_below, kept, layers.activation, layers.slope)
        else:
            pull_back(error_below, below, layers.activation, np.float32(layers.slope))


@vectorised
def _sum_rows(rows: Singles, total: Singles) -> None:
    total[:] = 0
    for i in range(len(rows)):
        row = rows[i]
        for j in range(len(total)):
            total[j] += row[j]


@vectorised
def _add_rows(rows: Singles, indices: Ints, totals: Singles) -> None:
    """Add each row to the one of the totals that its index names, all others being zero."""
    totals[:] = 0
    for i in range(len(rows)):
        row, total = rows[i], totals[indices[i]]
        for j in range(len(row)):
            total[j] += row[j]
