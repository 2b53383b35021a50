"""The state of environments, read into the records of the compiled loop and written back.

What comes next, interpreted or compiled, then goes on from the same place.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.compiled.cart_pole import CART_POLE_ENV, STATE, CartPole
from agents.compiled.compile_envs import World, layers, monitor_of
from agents.compiled.env_steps import add_to_return
from agents.compiled.episodes import Episodes
from agents.compiled.finite_model import FINITE_ENV
from agents.compiled.mountain_car import CAR_STATE, MOUNTAIN_CAR_ENV, MountainCar
from agents.compiled.training_records import env_records
from mdp.array_types import Floats

# Python's sum of floats makes up for rounding from this version on.
COMPENSATED_SUM = sys.version_info >= (3, 12)

# Of environments whose state is a vector: what it consists of, and their records.
VECTOR_STATES: dict[type, tuple[tuple[str, ...], np.dtype[np.void]]] = {
    CartPole: (STATE, CART_POLE_ENV),
    MountainCar: (CAR_STATE, MOUNTAIN_CAR_ENV),
}


class EnvStates:
    """Environments of a training, and a record for each of them.

    Args:
        vec_env: the environments.
        world: their compiled counterpart.

    Attributes:
        records: of `FINITE_ENV`, or as `VECTOR_STATES` has them, shape (n_envs,).
        vector_state: what the state consists of, where it is a vector; else nothing.
    """

    def __init__(self, vec_env: DummyVecEnv, world: World) -> None:
        self.vec_env = vec_env
        self.vector_state, self._record_type = VECTOR_STATES.get(type(world), ((), FINITE_ENV))
        self.records = env_records(vec_env.num_envs, self.record_type())
        self.monitors = [monitor_of(env) for env in vec_env.envs]
        # Monitor holds the rewards of the episode that is under way: so must we.
        self._unfinished: list[list[Floats]] = [[] for _ in vec_env.envs]

    def record_type(self) -> np.dtype[np.void]:
        """What the records hold."""
        return self._record_type

    def observation(self, i: int) -> Any:
        """What environment ``i`` shows."""
        return self.records[i]["obs"]

    def observations(self, records: Any, prefix: str) -> Any:
        """What environments show now (no prefix), before (``next_``) or after a reset (``new_``).

        Returns:
            Observations of shape (n, ...).
        """
        return records[f"{prefix}obs"].copy()

    def take_observations(self, last_obs: Any) -> None:
        """Let the records begin with these observations, shape (n, ...)."""
        self.records["obs"] = last_obs

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
        """Put the environments where their records are."""
        for i, env in enumerate(self.vec_env.envs):
            self._write_state(env.unwrapped, self.records[i])
            for layer in layers(env):
                if isinstance(layer, TimeLimit):
                    vars(layer)["_elapsed_steps"] = int(self.records[i]["elapsed"])
                elif isinstance(layer, Monitor):
                    chunks = self._unfinished[i]
                    layer.rewards = np.concatenate(chunks).tolist() if chunks else []
                    layer.needs_reset = False
            next(iter(self.vec_env.buf_obs.values()))[i] = self.observation(i)

    def _write_state(self, base: Any, record: Any) -> None:
        if self.vector_state:
            base.state = np.array([record[name] for name in self.vector_state])
            if hasattr(base, "steps_beyond_terminated"):
                base.steps_beyond_terminated = None
            return
        base.s = int(record["state"])
        if hasattr(base, "lastaction"):
            base.lastaction = None if record["elapsed"] == 0 else int(record["action"])
        if hasattr(base, "pulls_done"):
            base.pulls_done = int(record["elapsed"])

    def keep_rewards(self, episodes: Episodes, rewards: Floats) -> None:
        """Keep the rewards of episodes under way after a block.

        Args:
            episodes: those that have ended in it.
            rewards: as in `agents.compiled.loop.EpisodeLog`, as many as steps were done.
        """
        for i in range(len(self.records)):
            ends = episodes.steps[episodes.envs == i]
            if len(ends):
                self._unfinished[i] = []
            n_new = len(rewards) - (int(ends[-1]) + 1 if len(ends) else 0)
            if n_new > 0:
                self._unfinished[i].append(rewards[:n_new, i].copy())


def _elapsed_steps(env: gym.Env[Any, Any]) -> int:
    """Steps of the episode under way, by whichever counter knows them."""
    for layer in layers(env):
        if isinstance(layer, TimeLimit):
            return int(vars(layer)["_elapsed_steps"] or 0)
        if isinstance(layer, Monitor):
            return len(layer.rewards)
    return 0
