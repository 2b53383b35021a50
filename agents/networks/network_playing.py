"""Networks that act on compiled environments, learning nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th

from agents.networks.library_networks import Network
from agents.networks.matrix_products import Singles
from agents.networks.observations import BEFORE, look, move_on
from agents.networks.perceptron import Inputs, Layers, make_inputs, make_outputs
from agents.networks.q_learner import choose_greedily
from agents.networks.references import Reference, address_of, call
from agents.networks.shared_tensors import FlatTensors
from mdp.machine_code import inlined


class GreedyNetwork(NamedTuple):
    """A network whose largest output is the best action, by reference.

    Attributes:
        layers: its shape.
        flat: its parameters.
        single: one observation, to act on.
        single_outputs: for what is put out for it.
    """

    layers: Layers
    flat: Singles
    single: Inputs
    single_outputs: Singles


class NetworkPlayer(NamedTuple):
    """What the compiled loop asks.

    Attributes:
        network: a reference to a `GreedyNetwork`.
        seen: how observations are read, of `agents.networks.observations`.
        choose: the address of `choose_greedily`.
    """

    network: Any
    seen: Any
    choose: np.uintp

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


def network_player(network: Network, seen: Any) -> NetworkPlayer:
    """A network as it is now, whose parameters are copied.

    Args:
        network: its largest output is the best action.
        seen: how observations are read, of `agents.networks.observations`.
    """
    tensors, layers = FlatTensors([network]), network.layers
    with th.no_grad():
        for parameter, place in tensors.places:
            place.copy_(parameter)
    held = Reference(
        GreedyNetwork(layers, tensors.vector, make_inputs(layers, 1), make_outputs(layers, 1))
    )
    return NetworkPlayer(held, seen, address_of(choose_greedily, held))
