"""The compiled loop for agents on active tiles."""

from __future__ import annotations

from typing import Any, NamedTuple

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from agents.compiled.engine import CompiledEngine
from agents.compiled.greedy_play import Playground
from agents.networks.network_worlds import (
    NetworkEnvStates,
    network_playground,
    network_world,
)


class SeenWorld(NamedTuple):
    """A compiled environment, and how its observations are read.

    Attributes:
        world: what `agents.compiled.loop` steps.
        seen: one of the kinds of `agents.networks.observations`.
    """

    world: Any
    seen: Any


def tile_world(vec_env: VecEnv) -> SeenWorld:
    """The compiled counterpart of environments.

    Raises:
        NotCompilable: where there is none; the message says why.
    """
    return SeenWorld(*network_world(vec_env))


class TileEngine(CompiledEngine):
    """One call of ``learn`` on the compiled loop.

    Args:
        agent: the algorithm, whose weights and generator are used in place.
        seen_world: the compiled counterpart of its environments.
        callback: what is told of the steps.
        log_interval: episodes between two log records, or None.
    """

    def __init__(
        self, agent: Any, seen_world: SeenWorld, callback: BaseCallback, log_interval: int | None
    ) -> None:
        self.seen = seen_world.seen
        super().__init__(agent, seen_world.world, callback, log_interval)

    def _make_states(self) -> NetworkEnvStates:
        return NetworkEnvStates(self.agent.env, self.world, self.seen)

    def _playground(self, vec_env: VecEnv) -> Playground:
        return network_playground(vec_env)

    def _compiled_agent(self) -> Any:
        return self.agent.compiled_agent(self.agent.rng, self.seen)
