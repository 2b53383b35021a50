"""Sums of weights that act on compiled environments, learning nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

from agents.linear.tile_coding import Tiles
from agents.linear.weighted_tiles import LinearAgent, Room, add_up, look
from agents.networks.observations import BEFORE, move_on
from agents.networks.q_updates import best_of
from machine_code.compiling import called
from mdp.array_types import Floats


class TilePlayer(NamedTuple):
    """Takes the first of the actions with the highest sum; attributes as in `LinearAgent`."""

    weights: Floats
    tiles: Tiles
    seen: Any
    room: Room

    @called
    def act(self: Any, env: Any, progress: Any) -> None:
        """Take the best action."""
        look(self, env, BEFORE, self.room.tiles)
        add_up(self, self.room.tiles)
        env.action = best_of(self.room.sums)

    @called
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Nothing is learnt; the next observations are there."""
        for i in range(len(envs)):
            move_on(self.seen, envs[i])


def tile_player(agent: LinearAgent) -> TilePlayer:
    """The agent without what it explores and learns by; the weights stay where they are."""
    return TilePlayer(agent.weights, agent.tiles, agent.seen, agent.room)
