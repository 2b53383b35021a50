"""From networks and optimizers of Stable-Baselines3 to those of compiled code."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from agents.compiled.compile_envs import NotCompilable
from agents.networks import activations
from agents.networks.perceptron import Layers, make_layers

# The classes, what they are here, and the attribute that holds their parameter.
_ACTIVATIONS: dict[type[nn.Module], tuple[int, str | None]] = {
    nn.Identity: (activations.IDENTITY, None),
    nn.ReLU: (activations.RELU, None),
    nn.Tanh: (activations.TANH, None),
    nn.ELU: (activations.ELU, "alpha"),
    nn.LeakyReLU: (activations.LEAKY_RELU, "negative_slope"),
    nn.Sigmoid: (activations.SIGMOID, None),
    nn.SELU: (activations.SELU, None),
    nn.Softplus: (activations.SOFTPLUS, "beta"),
    nn.SiLU: (activations.SILU, None),
    nn.GELU: (activations.GELU, None),
    nn.Mish: (activations.MISH, None),
}

# From here on Softplus takes its input for its output, which rounding does as well.
_SOFTPLUS_THRESHOLD = 20

# Settings of optimizers that compiled steps do not have, as they have to be.
_PLAIN = {"amsgrad": False, "maximize": False, "momentum": 0, "centered": False}
_OPTIMIZERS = {th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, RMSpropTFLike}


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
    kind, slope = functions[0] if functions else (activations.IDENTITY, 0.0)
    sizes = [linears[0].in_features, *(linear.out_features for linear in linears)]
    return Network(linears, make_layers(sizes, start, kind, slope, one_hot=one_hot))


def _activation(module: nn.Module) -> tuple[int, float]:
    if type(module) not in _ACTIVATIONS:
        raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    kind, parameter = _ACTIVATIONS[type(module)]
    if isinstance(module, nn.GELU) and module.approximate == "tanh":
        kind = activations.FAST_GELU
    if isinstance(module, nn.Softplus) and module.threshold != _SOFTPLUS_THRESHOLD:
        raise NotCompilable(f"a network has a Softplus with a threshold of {module.threshold:g}")
    slope = 0.0 if parameter is None else float(getattr(module, parameter))
    if slope < 0:
        raise NotCompilable(f"a network has a layer of {type(module).__name__} that falls")
    return kind, slope


def check_optimizer(optimizer: th.optim.Optimizer) -> None:
    """Make sure that compiled steps are those of the optimizer.

    Raises:
        NotCompilable: if they are not; the message says why.
    """
    if type(optimizer) not in _OPTIMIZERS:
        raise NotCompilable(f"its optimizer is {type(optimizer).__name__}, not Adam or RMSprop")
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
