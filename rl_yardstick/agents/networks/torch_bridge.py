"""Shares the memory of PyTorch's networks and optimizers with compiled code."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.networks.perceptron import (
    ADAM,
    ADAMW,
    IDENTITY,
    RELU,
    RMSPROP,
    RMSPROP_TENSORFLOW,
    TANH,
    Layers,
    Optimizer,
    Singles,
    make_layers,
    n_parameters,
)

_ACTIVATIONS: dict[type[nn.Module], int] = {nn.Identity: IDENTITY, nn.ReLU: RELU, nn.Tanh: TANH}

# The values that settings of optimizers must have if compiled steps do not support them.
_PLAIN = {"amsgrad": False, "maximize": False, "momentum": 0, "centered": False}
_OPTIMIZERS = {th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, RMSpropTFLike}


@dataclass(frozen=True)
class Network:
    """A perceptron of the library: its layers in order, and their shape for compiled code."""

    linears: Sequence[nn.Linear]
    layers: Layers

    @property
    def parameters(self) -> list[th.Tensor]:
        """The weights and biases, in the order of the flat vector."""
        return [p for linear in self.linears for p in (linear.weight, linear.bias)]


def network_of(modules: Iterable[nn.Module], start: int, *, one_hot: bool) -> Network:
    """The perceptron of these modules: linear layers with one activation function in between.

    Its parameters begin at ``start`` of the flat vector. Raises NotCompilable for other modules.
    """
    linears: list[nn.Linear] = []
    functions: list[int] = []
    for module in modules:
        if type(module) is nn.Linear and module.bias is not None:
            if len(linears) != len(functions):
                raise NotCompilable("a network has linear layers without a function in between")
            linears.append(module)
        elif len(functions) == len(linears) - 1 and type(module) in _ACTIVATIONS:
            functions.append(_ACTIVATIONS[type(module)])
        else:
            raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    if len(set(functions)) > 1:
        raise NotCompilable("a network has several activation functions")
    if len(functions) != len(linears) - 1:
        raise NotCompilable("a network ends with an activation function")
    sizes = [linears[0].in_features, *(linear.out_features for linear in linears)]
    activation = functions[0] if functions else IDENTITY
    return Network(linears, make_layers(sizes, start, activation, one_hot=one_hot))


def check_optimizer(optimizer: th.optim.Optimizer) -> None:
    """Raise `NotCompilable` if compiled steps would differ from those of the optimizer."""
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


# While an agent trains, its tensors are views of flat vectors, so callbacks can read and change
# the parameters at any time. Afterwards the tensors have their own memory again, in PyTorch's
# layout.


class FlatTensors:
    """A flat vector of networks' parameters, with a view of it for each parameter."""

    def __init__(self, networks: Sequence[Network]) -> None:
        self.vector: Singles = np.zeros(sum(n_parameters(n.layers) for n in networks), np.float32)
        self.places: list[tuple[th.Tensor, th.Tensor]] = []
        begin = 0
        for parameter in (p for network in networks for p in network.parameters):
            end = begin + parameter.numel()
            # Compiled code stores weights as (inputs, outputs).
            turned = self.vector[begin:end].reshape(tuple(parameter.shape)[::-1])
            self.places.append((parameter, th.from_numpy(turned.T)))
            begin = end

    def take_over(self) -> None:
        """Move parameters into the vector, e.g. after a callback has replaced them."""
        for parameter, place in self.places:
            if parameter.data_ptr() != place.data_ptr():
                place.copy_(parameter.data)
                parameter.data = place

    def give_back(self) -> None:
        """Give the parameters their own memory again."""
        for parameter, _ in self.places:
            parameter.data = parameter.data.clone(memory_format=th.contiguous_format)


class SharedOptimizer:
    """The state of a policy's optimizer for the networks' parameters, in flat vectors."""

    def __init__(self, policy: Any, networks: Sequence[Network]) -> None:
        self.parameters = [p for network in networks for p in network.parameters]
        self.optimizer = policy.optimizer
        known: Any = self.optimizer.state
        kind, names = _kind(self.optimizer)
        means = {name: FlatTensors(networks) for name in names}
        n_steps = np.zeros(1, np.float32)
        if self.parameters[0] in known:
            n_steps[0] = float(known[self.parameters[0]]["step"])
        # As in the library, the mean of squares of RMSpropTFLike begins with ones.
        begins = th.tensor(1.0 if kind == RMSPROP_TENSORFLOW else 0.0)
        for name, tensors in means.items():
            for parameter, place in tensors.places:
                place.copy_(known[parameter].get(name, begins))
                known[parameter][name] = place
        for parameter in self.parameters:
            known[parameter]["step"] = th.from_numpy(n_steps)[0]
        vectors = [tensors.vector for tensors in means.values()]
        group = self.optimizer.param_groups[0]
        momentum, smoothing = group.get("betas", (0.0, group.get("alpha")))
        self.compiled = Optimizer(
            kind,
            float(momentum),
            float(smoothing),
            float(group["eps"]),
            float(group["weight_decay"]),
            vectors[0],
            vectors[-1],
            n_steps,
        )

    def give_back(self) -> None:
        """Give its state its own memory again; without a step, it has no state."""
        known: Any = self.optimizer.state
        kind, _ = _kind(self.optimizer)
        remembered = [parameter for parameter in self.parameters if parameter in known]
        for parameter in remembered:
            known[parameter] = _own_memory(known[parameter], kind)
        if not any(known[parameter]["step"] for parameter in remembered):
            known.clear()


def in_rows(state: Any) -> Any:
    """A copy of a ``state_dict`` with contiguous tensors, as in the library."""
    if isinstance(state, dict):
        copied = copy(state)
        copied.update({name: in_rows(value) for name, value in state.items()})
        return copied
    return state.contiguous() if isinstance(state, th.Tensor) else state


def _own_memory(state: dict[str, Any], kind: int) -> dict[str, Any]:
    """A copy of an optimizer's state of a parameter, in PyTorch's memory layout."""
    copied = {
        name: value.clone(memory_format=th.contiguous_format)
        if isinstance(value, th.Tensor)
        else value
        for name, value in state.items()
    }
    if kind == RMSPROP_TENSORFLOW:
        copied["step"] = int(copied["step"])
    return copied


def _kind(optimizer: th.optim.Optimizer) -> tuple[int, tuple[str, ...]]:
    """The kind of the optimizer here, and PyTorch's names of its running means."""
    if isinstance(optimizer, th.optim.Adam):
        decoupled = optimizer.param_groups[0]["decoupled_weight_decay"]
        return ADAMW if decoupled else ADAM, ("exp_avg", "exp_avg_sq")
    if isinstance(optimizer, RMSpropTFLike):
        return RMSPROP_TENSORFLOW, ("square_avg",)
    return RMSPROP, ("square_avg",)
