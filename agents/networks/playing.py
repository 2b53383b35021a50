"""Networks that act on compiled environments, learning nothing.

Compiled sums are rounded in another order than PyTorch's. Where two actions are so close that this
could decide, the library's `predict` does: what is played is what it would have played.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th

from agents.common.exploration import first_best
from agents.networks.network_worlds import BEFORE, look, move_on
from agents.networks.perceptron import (
    Inputs,
    Layers,
    Singles,
    forward,
    last_outputs,
    make_inputs,
    make_outputs,
    outputs_of,
    weights_of,
)
from agents.networks.torch_bridge import FlatTensors, Network, Reference, address_of, call
from machine_code.compiling import inlined, kernel

# By so much, relative to what is added up for an output, the best has to be ahead: ten times what
# rounding made of 64 to 400 units. And by so much at least, since PyTorch compares probabilities.
CLEARLY, AT_LEAST = 4e-6, 1e-6

_ASKED = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_double, ctypes.c_double)


class GreedyNetwork(NamedTuple):
    """A network whose largest output is the best action, by reference."""

    layers: Layers  # its shape
    flat: Singles  # its parameters
    single: Inputs  # one observation, to act on
    single_outputs: Singles  # for what is put out for it
    ask: np.uintp  # the address of what says the action where two are close


@kernel
def choose_surely(network: Any, _: float, __: float) -> int:
    """The best action for the observation in ``network.single``."""
    forward(network.layers, network.flat, network.single, 1, network.single_outputs)
    outputs = last_outputs(network.layers, network.single_outputs, 1)[0]
    best, unsure = first_best(outputs), _unsure(network, outputs)
    for k in range(len(outputs)):
        # Numbers that are none are not ahead either.
        if k != best and not outputs[best] - outputs[k] > unsure:
            return call(network.ask, network, 0.0, 0.0)
    return best


@inlined
def _unsure(network: Any, outputs: Singles) -> float:
    """Up to which difference rounding may decide between two outputs."""
    layers, last, most = network.layers, len(network.layers.sizes) - 2, 0.0
    weights = weights_of(layers, network.flat, last)
    for k in range(len(outputs)):
        added = abs(outputs[k])
        if last > 0:
            below = outputs_of(layers, network.single_outputs, last - 1, 1)[0]
            for j in range(len(below)):
                added += abs(below[j] * weights[j, k])
        most = max(most, added)
    return max(CLEARLY * most, AT_LEAST)


class AskingNetwork(Reference):
    """A reference to a `GreedyNetwork`, which asks ``predict`` where two actions are close."""

    def __init__(self, layers: Layers, flat: Singles, predict: Callable[[Inputs], int]) -> None:
        self.predict = predict
        # What `predict` has raised, which cannot pass through compiled code.
        self.errors: list[BaseException] = []
        # Compiled code does not keep it alive.
        self._called = _ASKED(self._answer)
        ask = np.uintp(ctypes.cast(self._called, ctypes.c_void_p).value or 0)
        inputs, outputs = make_inputs(layers, 1), make_outputs(layers, 1)
        super().__init__(GreedyNetwork(layers, flat, inputs, outputs, ask))

    def _answer(self, _: int | None, __: float, ___: float) -> int:
        if self.errors:
            return 0
        try:
            return self.predict(self.held.single)
        except BaseException as error:  # noqa: BLE001  # raised once compiled code has returned
            self.errors.append(error)
            return 0


class NetworkPlayer(NamedTuple):
    """The agent as the compiled loop calls it."""

    network: Any  # an `AskingNetwork`
    seen: Any  # how observations are read, of `agents.networks.network_worlds`
    choose: np.uintp  # the address of `choose_surely`

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Take the best action."""
        look(self.seen, env, BEFORE, self.network.single, self.network.layers.one_hot)
        env.action = call(self.choose, self.network, 0.0, 0.0)

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Nothing is learnt; the next observations are there."""
        for i in range(len(envs)):
            move_on(self.seen, envs[i])

    def check(self) -> None:
        """Raise what the library's `predict` has raised."""
        if errors := self.network.errors:
            raise errors.pop()


def network_player(network: Network, seen: Any, predict: Callable[[Inputs], int]) -> NetworkPlayer:
    """A network as it is now, whose parameters are copied."""
    tensors = FlatTensors([network])
    with th.no_grad():
        for parameter, place in tensors.places:
            place.copy_(parameter)
    asking = AskingNetwork(network.layers, tensors.vector, predict)
    return NetworkPlayer(asking, seen, address_of(choose_surely, asking))
