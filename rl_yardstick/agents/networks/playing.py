"""Networks that act on compiled environments without learning.

Compiled sums are rounded in another order than PyTorch's. If two actions are so close that rounding
could decide, the library's `predict` chooses, so that the actions are the same as the library's.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th

from rl_yardstick.agents.common.exploration import first_best
from rl_yardstick.agents.compiled.env_states import (
    BEFORE,
    look,
    move_on,
)
from rl_yardstick.agents.compiled.references import Reference, address_of, call
from rl_yardstick.agents.networks.perceptron import (
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
from rl_yardstick.agents.networks.torch_bridge import FlatTensors, Network
from rl_yardstick.machine_code.compiling import inlined, kernel

# The best output must be ahead by this share of the sum of magnitudes (ten times the rounding error
# with 64 to 400 units), and by at least this much, because PyTorch compares probabilities.
CLEARLY, AT_LEAST = 4e-6, 1e-6

_ASKED = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_double, ctypes.c_double)


class GreedyNetwork(NamedTuple):
    """A network whose largest output is the best action, by reference."""

    layers: Layers  # its shape
    flat: Singles  # its parameters
    single: Inputs  # buffer for one observation
    single_outputs: Singles  # buffer for its outputs
    ask: np.uintp  # the address of the function that chooses if two actions are close


@kernel
def choose_surely(network: Any, _: float, __: float) -> int:
    """The best action for the observation in ``network.single``."""
    forward(network.layers, network.flat, network.single, 1, network.single_outputs)
    outputs = last_outputs(network.layers, network.single_outputs, 1)[0]
    best, unsure = first_best(outputs), _unsure(network, outputs)
    for k in range(len(outputs)):
        # With nan the comparison is False, too.
        if k != best and not outputs[best] - outputs[k] > unsure:
            return call(network.ask, network, 0.0, 0.0)
    return best


@inlined
def _unsure(network: Any, outputs: Singles) -> float:
    """The largest difference of two outputs at which rounding may decide."""
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
    """A reference to a `GreedyNetwork`, which calls ``predict`` if two actions are close."""

    def __init__(self, layers: Layers, flat: Singles, predict: Callable[[Inputs], int]) -> None:
        self.predict = predict
        # Exceptions of `predict`, which cannot pass through compiled code.
        self.errors: list[BaseException] = []
        # Kept here, because compiled code does not keep it alive.
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
    """The agent for the compiled loop."""

    network: Any  # an `AskingNetwork`
    seen: Any  # how observations are read, of `agents.compiled.env_states`
    choose: np.uintp  # the address of `choose_surely`

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Take the best action."""
        look(self.seen, env, BEFORE, self.network.single, self.network.layers.one_hot)
        env.action = call(self.choose, self.network, 0.0, 0.0)

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Learn nothing; move on to the next observations."""
        for i in range(len(envs)):
            move_on(self.seen, envs[i])

    def check(self) -> None:
        """Raise the exception of the library's `predict`, if there was one."""
        if errors := self.network.errors:
            raise errors.pop()


def network_player(network: Network, seen: Any, predict: Callable[[Inputs], int]) -> NetworkPlayer:
    """A player with a copy of a network's present parameters."""
    tensors = FlatTensors([network])
    with th.no_grad():
        for parameter, place in tensors.places:
            place.copy_(parameter)
    asking = AskingNetwork(network.layers, tensors.vector, predict)
    return NetworkPlayer(asking, seen, address_of(choose_surely, asking))
