"""The tensors of an agent's networks and of its optimizer, in memory that compiled code works on.

While an agent trains, its tensors look into flat vectors, so that callbacks see at any time what
has been learnt, and what they change counts. Afterwards the tensors have memory of their own again,
laid out as PyTorch does it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from agents.compiled.compile_envs import NotCompilable
from agents.networks.library_networks import Network, check_optimizer
from agents.networks.matrix_products import Singles
from agents.networks.optimizers import ADAM, ADAMW, RMSPROP, RMSPROP_TENSORFLOW, Optimizer
from agents.networks.perceptron import n_parameters

# What an optimizer's group holds that compiled steps go by.
_SETTINGS = ("betas", "alpha", "eps", "weight_decay", "decoupled_weight_decay")


class FlatTensors:
    """Tensors of linear layers that look into a flat vector.

    Args:
        networks: whose layers, one network after the other.

    Attributes:
        vector: all of the numbers.
        places: the layers' parameters, each with its part of the vector in its shape.
    """

    def __init__(self, networks: Sequence[Network]) -> None:
        self.vector: Singles = np.zeros(sum(n_parameters(n.layers) for n in networks), np.float32)
        linears = [linear for network in networks for linear in network.linears]
        self.places = list(self._places(linears))

    def _places(self, linears: Sequence[nn.Linear]) -> Iterator[tuple[th.Tensor, th.Tensor]]:
        begin = 0
        for linear in linears:
            for parameter in (linear.weight, linear.bias):
                end = begin + parameter.numel()
                # Compiled code has weights as (inputs, outputs).
                turned = self.vector[begin:end].reshape(tuple(parameter.shape)[::-1])
                yield parameter, th.from_numpy(turned.T)
                begin = end


class SharedParameters(FlatTensors):
    """The parameters of networks, in one flat vector."""

    def __init__(self, networks: Sequence[Network]) -> None:
        super().__init__(networks)
        self.take_over()

    def take_over(self) -> None:
        """Copy those into the vector that lie elsewhere, as somebody has put them there."""
        for parameter, place in self.places:
            if parameter.data_ptr() != place.data_ptr():
                place.copy_(parameter.data)
                parameter.data = place

    def give_back(self) -> None:
        """Let them have memory of their own."""
        for parameter, _ in self.places:
            parameter.data = parameter.data.clone(memory_format=th.contiguous_format)


class SharedOptimizer:
    """What the optimizer of a policy remembers, in flat vectors.

    Args:
        policy: the policy.
        networks: those that are trained.
    """

    def __init__(self, policy: Any, networks: Sequence[Network]) -> None:
        self.policy = policy
        self.networks = networks
        self.parameters = [parameter for parameter, _ in FlatTensors(networks).places]
        self._share()

    def current(self) -> Optimizer:
        """The optimizer as compiled code sees it; another one where somebody has changed it.

        Raises:
            NotCompilable: if it has become one that compiled code does not know.
        """
        if self._made_from() != self.made_from:
            self.give_back()
            check_optimizer(self.policy.optimizer)
            self._share()
        return self.compiled

    def _share(self) -> None:
        self.optimizer = self.policy.optimizer
        known: Any = self.optimizer.state
        kind, names = _kind(self.optimizer)
        means = {name: FlatTensors(self.networks) for name in names}
        n_steps = np.zeros(1, np.float32)
        if self.parameters[0] in known:
            n_steps[0] = float(known[self.parameters[0]]["step"])
        # As the library has it: the mean of squares begins with ones there.
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
        self.made_from = self._made_from()

    def _made_from(self) -> tuple[Any, ...]:
        """What changes where somebody loads another state, or takes another optimizer."""
        optimizer = self.policy.optimizer
        group = optimizer.param_groups[0]
        settings = [group.get(name) for name in _SETTINGS]
        states = [optimizer.state.get(parameter, {}) for parameter in self.parameters]
        memory = [_place_of(value) for state in states for value in state.values()]
        trained = [parameter.requires_grad for parameter in self.parameters]
        return id(optimizer), settings, memory, trained

    def give_back(self) -> None:
        """Let what it remembers have memory of its own; nothing, where it has taken no step."""
        known: Any = self.optimizer.state
        kind, _ = _kind(self.optimizer)
        remembered = [parameter for parameter in self.parameters if parameter in known]
        for parameter in remembered:
            known[parameter] = _own_memory(known[parameter], kind)
        if not any(known[parameter]["step"] for parameter in remembered):
            known.clear()


class SharedTensors:
    """All tensors of an agent that lie in the memory of compiled code.

    Args:
        policy: the agent's policy.
        networks: those that are trained, in the order of the flat vector.
        lagging: copies of them that lag behind.

    Attributes:
        networks: the same.
        trained: the parameters of the networks.
        lagging: those of the copies.
        optimizer: what moves the networks.
    """

    def __init__(
        self, policy: Any, networks: Sequence[Network], lagging: Sequence[Network] = ()
    ) -> None:
        self.networks = networks
        self.trained, self.lagging = SharedParameters(networks), SharedParameters(lagging)
        self.optimizer = SharedOptimizer(policy, networks)

    def take_over(self) -> Optimizer:
        """Let count what somebody has put in the place of tensors.

        Returns:
            The optimizer as compiled code sees it.

        Raises:
            ValueError: if it has become one that compiled code does not know.
        """
        self.trained.take_over()
        self.lagging.take_over()
        try:
            return self.optimizer.current()
        except NotCompilable as reason:
            raise ValueError(f"engine: compiled cannot go on: {reason}") from None

    def give_back(self) -> None:
        """Let all have memory of their own."""
        for part in (self.trained, self.lagging, self.optimizer):
            part.give_back()


@contextmanager
def shared_tensors(
    policy: Any, networks: Sequence[Network], lagging: Sequence[Network] = ()
) -> Iterator[SharedTensors]:
    """`SharedTensors` for a while."""
    shared = SharedTensors(policy, networks, lagging)
    try:
        yield shared
    finally:
        shared.give_back()


def in_rows(state: Any) -> Any:
    """What a ``state_dict`` holds, with tensors that lie in memory as the library lays them out."""
    if isinstance(state, dict):
        copied = copy(state)
        copied.update({name: in_rows(value) for name, value in state.items()})
        return copied
    return state.contiguous() if isinstance(state, th.Tensor) else state


def _place_of(value: Any) -> Any:
    return value.data_ptr() if isinstance(value, th.Tensor) else value


def _own_memory(state: dict[str, Any], kind: int) -> dict[str, Any]:
    """What an optimizer knows of a parameter, as PyTorch would have it in memory."""
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
    """What the optimizer is here, and what PyTorch calls the means that it keeps."""
    if isinstance(optimizer, th.optim.Adam):
        decoupled = optimizer.param_groups[0]["decoupled_weight_decay"]
        return ADAMW if decoupled else ADAM, ("exp_avg", "exp_avg_sq")
    if isinstance(optimizer, RMSpropTFLike):
        return RMSPROP_TENSORFLOW, ("square_avg",)
    return RMSPROP, ("square_avg",)
