"""The observations of compiled environments, as inputs of networks.

Environments keep numbers of states; CartPole and MountainCar, with infinitely many states, keep
vectors. Networks and their buffers need rows. Functions are chosen by type
(`agents.compiled.loop`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.compiled.greedy_play import VECTOR_STATES, EnvStates
from rl_yardstick.agents.compiled.loop import by_type, reset, step
from rl_yardstick.agents.compiled.worlds import (
    CartPole,
    MountainCar,
    NotCompilable,
    compile_envs,
    env_dtype,
)
from rl_yardstick.agents.networks.perceptron import Inputs, Singles
from rl_yardstick.envs.known_models import observations_of_states
from rl_yardstick.machine_code.compiling import inlined

# Before a step; and after it, before any reset.
BEFORE, AFTER = range(2)


@by_type
def observe(seen: Any, env: Any, moment: int, row: Any) -> None:
    """Write the observation at this moment of the environment's last step into ``row``."""


@by_type
def move_on(seen: Any, env: Any) -> None:
    """Make the new observation the one that the next action is chosen for."""


@inlined
def number_at(env: Any, moment: int) -> int:
    """The number of the observation."""
    return int(env.obs if moment == BEFORE else env.next_obs)


@inlined
def look(seen: Any, env: Any, moment: int, inputs: Inputs, one_hot: int) -> None:
    """Write the observation at this moment into the first row of a network's inputs."""
    if one_hot:
        inputs.indices[0] = number_at(env, moment)
    else:
        observe(seen, env, moment, inputs.vectors[0])


@inlined
def show(inputs: Inputs, i: int, row: Any, one_hot: int) -> None:
    """Write a row of a buffer into the i-th row of a network's inputs."""
    if one_hot:
        inputs.indices[i] = int(row[0])
    else:
        for j in range(len(row)):
            inputs.vectors[i, j] = np.float32(row[j])


class Numbers(NamedTuple):
    """Observations are numbers, which networks get as one-hot vectors."""

    n: int  # how many there are

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The number itself, shape (1,)."""
        row[0] = number_at(env, moment)

    @inlined
    def move_on(self, env: Any) -> None:
        """Only the number changes."""
        env.obs = env.new_obs


class StateVectors(NamedTuple):
    """Observations are vectors, one for each state of a known model."""

    table: Singles  # the observation of each state, shape (S, d)

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that state, shape (d,)."""
        vector = self.table[number_at(env, moment)]
        for j in range(len(row)):
            row[j] = vector[j]

    @inlined
    def move_on(self, env: Any) -> None:
        """Only the number changes."""
        env.obs = env.new_obs


class OwnVectors(NamedTuple):
    """Observations are vectors that the environments' records hold."""

    n: int  # length of the vectors

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that moment, shape (n,)."""
        for j in range(self.n):
            row[j] = env.vector[j] if moment == BEFORE else env.next_vector[j]

    @inlined
    def move_on(self, env: Any) -> None:
        """All of the vector changes."""
        for j in range(self.n):
            env.vector[j] = env.new_vector[j]


# Fields that acting fills in for learning.
_ESTIMATES = (("value", np.float64), ("log_probability", np.float64))

_FINITE_ENV = env_dtype(("state", np.int64), *_ESTIMATES)


class InFull(NamedTuple):
    """CartPole or MountainCar, with its state as the observation."""

    time_limit: int  # steps after which an episode is truncated, or 0 for never
    dynamics: CartPole | MountainCar  # its compiled dynamics

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Take ``env.action``."""
        step(self.dynamics, env, handle)
        show_state(self.dynamics, env, env.next_vector)
        show_state(self.dynamics, env, env.new_vector)

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a state."""
        reset(self.dynamics, env, handle)
        show_state(self.dynamics, env, env.new_vector)


@by_type
def show_state(world: Any, env: Any, vector: Any) -> None:
    """Write the state of an environment into a vector."""


@lru_cache(maxsize=4)
def _record_in_full(names: tuple[str, ...]) -> np.dtype[np.void]:
    """The record type of an environment with a state of these numbers, also as vectors."""
    vectors: Any = [
        (name, np.float32, (len(names),)) for name in ("vector", "next_vector", "new_vector")
    ]
    return env_dtype(*((name, np.float64) for name in names), *_ESTIMATES, *vectors)


def network_world(vec_env: VecEnv) -> tuple[Any, Any]:
    """The compiled counterpart of environments, and how to read its observations."""
    world = compile_envs(vec_env)
    space = vec_env.observation_space
    if isinstance(space, spaces.Discrete):
        return world, Numbers(int(space.n))
    if isinstance(world, CartPole | MountainCar):
        names, _ = VECTOR_STATES[type(world)]
        return InFull(world.time_limit, world), OwnVectors(len(names))
    observed = observations_of_states(vec_env.envs[0])  # type: ignore[attr-defined]
    if observed is None or observed.ndim < 2:
        raise NotCompilable("the observations of the states are not known")
    return world, StateVectors(np.ascontiguousarray(observed.reshape(len(observed), -1), "f4"))


class NetworkEnvStates(EnvStates):
    """The states of a training's environments, with observations for networks."""

    def __init__(self, vec_env: Any, world: Any, seen: Any) -> None:
        self.seen = seen
        world = getattr(world, "dynamics", world)
        vectors = VECTOR_STATES.get(type(world))
        kind = _FINITE_ENV if vectors is None else _record_in_full(vectors[0])
        super().__init__(vec_env, world, kind)

    def observations(self, records: Any, prefix: str) -> Any:
        """The observations now (no prefix), before (``next_``) or after a reset (``new_``)."""
        if isinstance(self.seen, Numbers):
            return records[f"{prefix}obs"].copy()
        if isinstance(self.seen, OwnVectors):
            return records[f"{prefix}vector"].copy()
        shape = self.vec_env.observation_space.shape
        assert shape is not None
        return self.seen.table[records[f"{prefix}obs"]].reshape(len(records), *shape)

    def take_observations(self, last_obs: Any) -> None:
        """Set the records to these observations, shape (n, ...)."""
        if isinstance(self.seen, Numbers):
            self.records["obs"] = last_obs
        elif isinstance(self.seen, OwnVectors):
            self.records["vector"] = last_obs
        else:
            for record, shown in zip(self.records, last_obs, strict=True):
                record["obs"] = self._state_of(shown.ravel(), int(record["state"]))

    def _state_of(self, shown: Any, state: int) -> int:
        """A state with this observation: ``state`` if its observation fits, else the first such."""
        fits = (self.seen.table == shown.astype(np.float32)).all(axis=1)
        if not fits.any():
            raise ValueError("no state has the observation that the training is to go on from")
        return state if fits[state] else int(np.argmax(fits))
