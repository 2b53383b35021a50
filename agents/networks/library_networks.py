"""From networks of Stable-Baselines3 to perceptrons of compiled code, in the same memory.

While an agent trains, the tensors of its networks and of its optimizer look into flat vectors that
compiled code works on, so that callbacks see at any time what has been learnt. Afterwards they have
memory of their own again, laid out as PyTorch does it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from agents.compiled.compile_envs import NotCompilable
from agents.networks.activations import ELU, IDENTITY, LEAKY_RELU, RELU, SIGMOID, TANH
from agents.networks.matrix_products import Singles
from agents.networks.optimizers import ADAM, RMSPROP, RMSPROP_TENSORFLOW, Optimizer
from agents.networks.perceptron import Layers, make_layers, n_parameters

# The classes, what they are here, and the attribute that holds their parameter.
_ACTIVATIONS: dict[type[nn.Module], tuple[int, str | None]] = {
    nn.Identity: (IDENTITY, None),
    nn.ReLU: (RELU, None),
    nn.Tanh: (TANH, None),
    nn.ELU: (ELU, "alpha"),
    nn.LeakyReLU: (LEAKY_RELU, "negative_slope"),
    nn.Sigmoid: (SIGMOID, None),
}

# Settings of optimizers that compiled steps do not have, as they have to be.
_PLAIN = {
    "weight_decay": 0,
    "amsgrad": False,
    "maximize": False,
    "momentum": 0,
    "centered": False,
    "decoupled_weight_decay": False,
}


@dataclass(frozen=True)
class Network:
    """A perceptron of the library.

    Attributes:
        linears: its layers, the first one first.
        layers: the same as compiled code sees them.
    """

    linears: Sequence[nn.Linear]
    layers: Layers


def network_of(modules: Iterable[nn.Module], start: int, *, one_hot: bool) -> Network:
    """What linear layers with one activation function in between come to.

    Args:
        modules: the layers and functions, in order.
        start: where its parameters begin in the flat vector.
        one_hot: whether inputs are numbers that stand for one-hot vectors.

    Raises:
        NotCompilable: if it is anything else.
    """
    linears: list[nn.Linear] = []
    functions: list[tuple[int, float]] = []
    for module in modules:
        if type(module) is nn.Linear and module.bias is not None:
            if len(linears) != len(functions):
                raise NotCompilable("a network has linear layers without a function in between")
            linears.append(module)
        elif len(functions) == len(linears) - 1:
            functions.append(_activation(module))
        else:
            raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    if len(set(functions)) > 1:
        raise NotCompilable("a network has several activation functions")
    if len(functions) != len(linears) - 1:
        raise NotCompilable("a network ends with an activation function")
    kind, slope = functions[0] if functions else (IDENTITY, 0.0)
    sizes = [linears[0].in_features, *(linear.out_features for linear in linears)]
    return Network(linears, make_layers(sizes, start, kind, slope, one_hot=one_hot))


def _activation(module: nn.Module) -> tuple[int, float]:
    if type(module) not in _ACTIVATIONS:
        raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    kind, parameter = _ACTIVATIONS[type(module)]
    slope = 0.0 if parameter is None else float(getattr(module, parameter))
    if slope < 0:
        raise NotCompilable(f"a network has a layer of {type(module).__name__} that falls")
    return kind, slope


def check_optimizer(optimizer: th.optim.Optimizer) -> None:
    """Make sure that compiled steps are those of the optimizer.

    Raises:
        NotCompilable: if they are not; the message says why.
    """
    kind = type(optimizer)
    if kind not in {th.optim.Adam, th.optim.RMSprop, RMSpropTFLike}:
        raise NotCompilable(f"its optimizer is {kind.__name__}, not Adam or RMSprop")
    if len(optimizer.param_groups) != 1:
        raise NotCompilable("its optimizer has several groups of parameters")
    group = optimizer.param_groups[0]
    for name, plain in _PLAIN.items():
        if group.get(name, plain) != plain:
            raise NotCompilable(f"its optimizer has {name} {group[name]}")
    if not all(parameter.requires_grad for parameter in group["params"]):
        raise NotCompilable("some of its parameters are frozen")
    if any(parameter.dtype is not th.float32 for parameter in group["params"]):
        raise NotCompilable("its parameters are not in single precision")


class FlatTensors:
    """Tensors of linear layers that look into a flat vector.

    Args:
        networks: whose layers, one network after the other.
    """

    def __init__(self, networks: Sequence[Network]) -> None:
        self.linears = [linear for network in networks for linear in network.linears]
        self.size = sum(n_parameters(network.layers) for network in networks)
        self.vector: Singles = np.zeros(self.size, np.float32)

    def places(self) -> Iterator[tuple[th.Tensor, th.Tensor]]:
        """The layers' parameters, each with its part of the vector in the same shape."""
        begin = 0
        for linear in self.linears:
            for parameter in (linear.weight, linear.bias):
                end = begin + parameter.numel()
                # Compiled code has weights as (inputs, outputs).
                turned = self.vector[begin:end].reshape(tuple(parameter.shape)[::-1])
                yield parameter, th.from_numpy(turned.T)
                begin = end


@contextmanager
def shared_parameters(networks: Sequence[Network]) -> Iterator[Singles]:
    """Let the parameters of networks lie in one flat vector for a while.

    Yields:
        The vector.
    """
    tensors = FlatTensors(networks)
    for parameter, place in tensors.places():
        place.copy_(parameter.data)
        parameter.data = place
    try:
        yield tensors.vector
    finally:
        for parameter, _ in tensors.places():
            parameter.data = parameter.data.clone(memory_format=th.contiguous_format)


@contextmanager
def shared_optimizer(
    optimizer: th.optim.Optimizer, networks: Sequence[Network]
) -> Iterator[Optimizer]:
    """Let what an optimizer remembers lie in flat vectors for a while.

    Yields:
        The optimizer as compiled code sees it.
    """
    kind, names = _kind(optimizer)
    known: Any = optimizer.state
    means = {name: FlatTensors(networks) for name in names}
    parameters = [parameter for parameter, _ in means[names[0]].places()]
    n_steps = np.zeros(1, np.float32)
    if parameters[0] in known:
        n_steps[0] = float(known[parameters[0]]["step"])
    for name, tensors in means.items():
        for parameter, place in tensors.places():
            # As the library has it: the mean of squares begins with ones there.
            begins = 1.0 if kind == RMSPROP_TENSORFLOW else 0.0
            place.copy_(known[parameter].get(name, th.tensor(begins)))
            known[parameter][name] = place
    for parameter in parameters:
        known[parameter]["step"] = th.from_numpy(n_steps)[0]
    vectors = [tensors.vector for tensors in means.values()]
    group = optimizer.param_groups[0]
    momentum, smoothing = group.get("betas", (0.0, group.get("alpha")))
    epsilon = group["eps"]
    try:
        yield Optimizer(kind, momentum, smoothing, epsilon, vectors[0], vectors[-1], n_steps)
    finally:
        for parameter in parameters:
            known[parameter] = _own_memory(known[parameter], kind)
        if not n_steps[0]:
            known.clear()


def in_rows(state: Any) -> Any:
    """What a ``state_dict`` holds, with tensors that lie in memory as the library lays them out."""
    if isinstance(state, dict):
        copied = copy(state)
        copied.update({name: in_rows(value) for name, value in state.items()})
        return copied
    return state.contiguous() if isinstance(state, th.Tensor) else state


def _own_memory(state: dict[str, Any], kind: int) -> dict[str, Any]:
    """What an optimizer knows of a parameter, as PyTorch would have it in memory."""
    copied = {
        name: tensor.clone(memory_format=th.contiguous_format) for name, tensor in state.items()
    }
    if kind == RMSPROP_TENSORFLOW:
        copied["step"] = int(copied["step"])
    return copied


def _kind(optimizer: th.optim.Optimizer) -> tuple[int, tuple[str, ...]]:
    """What the optimizer is here, and what PyTorch calls the means that it keeps."""
    if type(optimizer) is th.optim.Adam:
        return ADAM, ("exp_avg", "exp_avg_sq")
    if type(optimizer) is RMSpropTFLike:
        return RMSPROP_TENSORFLOW, ("square_avg",)
    return RMSPROP, ("square_avg",)
