"""The state of environments in the records of the compiled loop, what is observed and logged.

Environments keep numbers of states; CartPole and MountainCar, with infinitely many states, keep
vectors. Functions are chosen by type (`agents.compiled.loop`).
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from rl_yardstick.agents.compiled.loop import add_to_return, by_type, reset, step
from rl_yardstick.agents.compiled.references import handles_of
from rl_yardstick.agents.compiled.worlds import (
    CAR_STATE,
    STATE,
    CartPole,
    MountainCar,
    NotCompilable,
    compile_envs,
    env_dtype,
    env_records,
    layers,
    monitor_of,
)
from rl_yardstick.envs.known_models import observations_of_states
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# Before a step; and after it, before any reset.
BEFORE, AFTER = range(2)


@by_type
def observe(seen: Any, env: Any, moment: int, row: Any) -> None:
    """Write the observation at this moment of the environment's last step into ``row``."""


@inlined
def number_at(env: Any, moment: int) -> int:
    """The number of the observation."""
    return int(env.obs if moment == BEFORE else env.next_obs)


@inlined
def look(seen: Any, env: Any, moment: int, inputs: Any, one_hot: int) -> None:
    """Write the observation at this moment into the first row of a network's inputs."""
    if one_hot:
        inputs.indices[0] = number_at(env, moment)
    else:
        observe(seen, env, moment, inputs.vectors[0])


@inlined
def show(inputs: Any, i: int, row: Any, one_hot: int) -> None:
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


class StateVectors(NamedTuple):
    """Observations are vectors, one for each state of a known model."""

    table: NDArray[np.float32]  # the observation of each state, shape (S, d)

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that state, shape (d,)."""
        vector = self.table[number_at(env, moment)]
        for j in range(len(row)):
            row[j] = vector[j]


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


def observed_world(vec_env: VecEnv) -> tuple[Any, Any]:
    """The compiled counterpart of environments, and how to read its observations."""
    world = compile_envs(vec_env)
    space = vec_env.observation_space
    if isinstance(space, spaces.Discrete):
        return world, Numbers(int(space.n))
    if isinstance(world, CartPole | MountainCar):
        return InFull(world.time_limit, world), OwnVectors(len(VECTOR_STATES[type(world)]))
    observed = observations_of_states(vec_env.envs[0])  # type: ignore[attr-defined]
    if observed is None or observed.ndim < 2:
        raise NotCompilable("the observations of the states are not known")
    return world, StateVectors(np.ascontiguousarray(observed.reshape(len(observed), -1), "f4"))


# The state of environments, read into records and written back. Interpreted or compiled code can
# then continue from the same state.

# From this version on, Python's sum of floats compensates for rounding.
COMPENSATED_SUM = sys.version_info >= (3, 12)

# For environments with a vector as state: the names of its parts.
VECTOR_STATES: dict[type, tuple[str, ...]] = {CartPole: STATE, MountainCar: CAR_STATE}


class EnvStates:
    """Environments, with a record for each; ``seen`` reads observations of the compiled world."""

    def __init__(self, vec_env: DummyVecEnv, world: Any, seen: Any) -> None:
        self.vec_env = vec_env
        self.seen = seen
        # The state is a vector of these names, or a number if there are none.
        self.vector_state = VECTOR_STATES.get(type(getattr(world, "dynamics", world)), ())
        state: Any = [(name, np.float64) for name in self.vector_state] or [("state", np.int64)]
        # Fields that acting fills in for learning.
        state += [("value", np.float64), ("log_probability", np.float64)]
        if isinstance(seen, OwnVectors):
            vectors = ("vector", "next_vector", "new_vector")
            state += [(name, np.float32, (len(self.vector_state),)) for name in vectors]
        self.records = env_records(vec_env.num_envs, env_dtype(*state))
        self.monitors = [monitor_of(env) for env in vec_env.envs]
        self.take_generators()
        # Monitor keeps the rewards of the running episode, so we keep them too.
        self._unfinished: list[list[Floats]] = [[] for _ in vec_env.envs]

    def take_generators(self) -> None:
        """Make handles of the environments' generators, which are kept alive here."""
        self.generators = [env.unwrapped.np_random for env in self.vec_env.envs]
        self.handles = handles_of(self.generators)

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
            raise ValueError("no state has the observation from which to resume the training")
        return state if fits[state] else int(np.argmax(fits))

    def read(self) -> None:
        """Copy the state of the environments into the records."""
        for i, env in enumerate(self.vec_env.envs):
            base: Any = env.unwrapped
            record = self.records[i]
            if self.vector_state:
                for name, value in zip(self.vector_state, base.state, strict=True):
                    record[name] = value
            else:
                record["state"] = base.s
            record["elapsed"] = _elapsed_steps(env)
            record["episode_return"] = record["compensation"] = 0.0
            self._unfinished[i] = []
            monitor = self.monitors[i]
            if monitor is not None and monitor.rewards:
                for reward in monitor.rewards:
                    add_to_return(record, reward, COMPENSATED_SUM)
                self._unfinished[i] = [np.array(monitor.rewards)]

    def write(self) -> None:
        """Copy the records into the state of the environments."""
        for i, env in enumerate(self.vec_env.envs):
            base: Any = env.unwrapped
            record = self.records[i]
            if self.vector_state:
                base.state = np.array([record[name] for name in self.vector_state])
                if hasattr(base, "steps_beyond_terminated"):
                    base.steps_beyond_terminated = None
            else:
                base.s = int(record["state"])
                if hasattr(base, "lastaction"):
                    base.lastaction = None if record["elapsed"] == 0 else int(record["action"])
                if hasattr(base, "pulls_done"):
                    base.pulls_done = int(record["elapsed"])
            for layer in layers(env):
                if isinstance(layer, TimeLimit):
                    vars(layer)["_elapsed_steps"] = int(record["elapsed"])
                elif isinstance(layer, Monitor):
                    chunks = self._unfinished[i]
                    layer.rewards = np.concatenate(chunks).tolist() if chunks else []
                    layer.needs_reset = False
            (shown,) = self.observations(self.records[i : i + 1], "")
            next(iter(self.vec_env.buf_obs.values()))[i] = shown

    def keep_rewards(self, episodes: Episodes, rewards: Floats) -> None:
        """Keep the rewards of unfinished episodes after a block."""
        for i in range(len(self.records)):
            ends = episodes.steps[episodes.envs == i]
            if len(ends):
                self._unfinished[i] = []
            n_new = len(rewards) - (int(ends[-1]) + 1 if len(ends) else 0)
            if n_new > 0:
                self._unfinished[i].append(rewards[:n_new, i].copy())


def _elapsed_steps(env: gym.Env[Any, Any]) -> int:
    """Steps of the running episode, by the first wrapper that counts them."""
    for layer in layers(env):
        if isinstance(layer, TimeLimit):
            return int(vars(layer)["_elapsed_steps"] or 0)
        if isinstance(layer, Monitor):
            return len(layer.rewards)
    return 0


# The episodes of a block, and their rows in Monitor's files.


# To which Monitor rounds returns and times.
DECIMALS = 6


@dataclass(frozen=True)
class Episodes:
    """Episodes that ended in a block, in order of time."""

    envs: Ints  # which environment each ran in, shape (n_episodes,)
    steps: Ints  # at which step of the block it ended, shape (n_episodes,)
    returns: Floats  # sum of its rewards, shape (n_episodes,)
    lengths: Ints  # number of its steps, shape (n_episodes,)
    successes: Bools  # whether it was a success, shape (n_episodes,)

    @classmethod
    def of(cls, log: NDArray[np.void]) -> Episodes:
        """The episodes of records of type `EPISODE`, shape (n_episodes,)."""
        return cls(log["env"], log["step"], log["episode_return"], log["length"], log["success"])

    def infos(self, chosen: slice, times: list[float]) -> list[dict[str, Any]]:
        """What Monitor would have put into ``info["episode"]`` for some of the episodes."""
        return [
            {"r": round(total, DECIMALS), "l": length, "t": times[env]}
            for env, total, length in zip(
                self.envs[chosen].tolist(),
                self.returns[chosen].tolist(),
                self.lengths[chosen].tolist(),
                strict=True,
            )
        ]


def record_in_monitors(
    monitors: list[Monitor | None], episodes: Episodes, n_steps: int
) -> list[float]:
    """Record a block of episodes in the Monitors, as each does at the end of an episode.

    Returns the time at the end of the block, which all get, in seconds since each was made.
    """
    times = []
    for i, monitor in enumerate(monitors):
        if monitor is None:
            times.append(0.0)
            continue
        monitor.total_steps += n_steps
        elapsed = time.time() - monitor.t_start
        times.append(round(elapsed, DECIMALS))
        chosen = slice(None) if len(monitors) == 1 else episodes.envs == i
        returns, lengths = episodes.returns[chosen].tolist(), episodes.lengths[chosen].tolist()
        monitor.episode_returns += returns
        monitor.episode_lengths += lengths
        monitor.episode_times += [elapsed] * len(returns)
        if monitor.results_writer is not None and returns:
            end = f"{times[i]}\r\n"
            file: Any = monitor.results_writer.file_handler
            file.write(end.join(map(_row, returns, lengths)) + end)
            file.flush()
    return times


@lru_cache(maxsize=10_000)  # equal episodes are common, and formatting is slow
def _row(episode_return: float, length: int) -> str:
    return f"{round(episode_return, DECIMALS)},{length},"
