"""Copies environments' states to and from compiled records, and plays without learning."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.agents.compiled.generators import handles_of
from rl_yardstick.agents.compiled.loop import (
    EpisodeLog,
    add_to_return,
    learn_from_last_step,
    run_block,
)
from rl_yardstick.agents.compiled.records import Episodes, record_in_monitors
from rl_yardstick.agents.compiled.worlds import (
    CAR_STATE,
    CART_POLE_ENV,
    EPISODE,
    FINITE_ENV,
    MOUNTAIN_CAR_ENV,
    PROGRESS,
    STATE,
    CartPole,
    MountainCar,
    World,
    env_records,
    layers,
    monitor_of,
)
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# The state of environments, read into the records of the compiled loop and written back.
#
# Interpreted or compiled code can then continue from the same state.

# From this version on, Python's sum of floats compensates for rounding.
COMPENSATED_SUM = sys.version_info >= (3, 12)

# For environments with a vector as state: the names of its parts, and the record type.
VECTOR_STATES: dict[type, tuple[tuple[str, ...], np.dtype[np.void]]] = {
    CartPole: (STATE, CART_POLE_ENV),
    MountainCar: (CAR_STATE, MOUNTAIN_CAR_ENV),
}


class EnvStates:
    """The training environments, with a record for each of them."""

    def __init__(
        self, vec_env: DummyVecEnv, world: World, kind: np.dtype[np.void] | None = None
    ) -> None:
        self.vec_env = vec_env
        # The state is a vector of these names, or a number if there are none.
        self.vector_state, own_kind = VECTOR_STATES.get(type(world), ((), FINITE_ENV))
        self.records = env_records(vec_env.num_envs, own_kind if kind is None else kind)
        self.monitors = [monitor_of(env) for env in vec_env.envs]
        # Monitor keeps the rewards of the running episode, so we keep them too.
        self._unfinished: list[list[Floats]] = [[] for _ in vec_env.envs]

    def observations(self, records: Any, prefix: str) -> Any:
        """Observations: current (no prefix), before (``next_``) or after a reset (``new_``)."""
        return records[f"{prefix}obs"].copy()

    def take_observations(self, last_obs: Any) -> None:
        """Store the current observations, shape (n, ...), in the records."""
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
        """Copy the records into the state of the environments."""
        for i, env in enumerate(self.vec_env.envs):
            self._write_state(env.unwrapped, self.records[i])
            for layer in layers(env):
                if isinstance(layer, TimeLimit):
                    vars(layer)["_elapsed_steps"] = int(self.records[i]["elapsed"])
                elif isinstance(layer, Monitor):
                    chunks = self._unfinished[i]
                    layer.rewards = np.concatenate(chunks).tolist() if chunks else []
                    layer.needs_reset = False
            (shown,) = self.observations(self.records[i : i + 1], "")
            next(iter(self.vec_env.buf_obs.values()))[i] = shown

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


# Episodes that an agent plays on compiled environments without learning.
#
# They equal the episodes of the library's `evaluate_policy`: the same generators, which end in the
# same state.

# Some hundredths of a second with networks, for which a signal may have to wait.
STEPS_AT_ONCE = 4096


class Plan(NamedTuple):
    """A player with a fixed action for each observed number."""

    actions: Ints  # one for each number, shape (S,)

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Look the action up."""
        env.action = self.actions[env.obs]

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Learn nothing; move on to the next observations."""
        for i in range(len(envs)):
            envs[i].obs = envs[i].new_obs


def play_episodes(
    world: Any, player: Any, states: EnvStates, observations: Any, wanted: Ints
) -> Episodes:
    """Play the wanted numbers of episodes on environments that have just been reset.

    All environments step until each has ended its number of episodes. The environments, their
    generators and their Monitors end in the state in which `evaluate_policy` would leave them.
    """
    states.read()
    states.take_observations(observations)
    n_envs = len(wanted)
    # Handles do not keep their generators alive.
    generators = [env.unwrapped.np_random for env in states.vec_env.envs]
    handles, progress = handles_of(generators), np.zeros(1, dtype=PROGRESS)
    log = EpisodeLog(
        np.zeros(STEPS_AT_ONCE * n_envs, dtype=EPISODE),
        np.empty((STEPS_AT_ONCE, n_envs)),
    )
    ended: Any = np.zeros(0, dtype=EPISODE)
    while n_missing := _n_missing(ended["env"], wanted):
        # At least this many more episodes must end.
        limits = STEPS_AT_ONCE, n_missing, COMPENSATED_SUM
        n_steps = run_block(world, player, states.records, handles, progress[0], log, *limits)
        learn_from_last_step(player, states.records, progress[0])
        if hasattr(player, "check"):
            player.check()
        new = log.episodes[: progress["logged_episodes"][0]]
        states.keep_rewards(Episodes.of(new), log.rewards[:n_steps])
        ended = np.concatenate([ended, new])
    n_done = int(progress["num_timesteps"][0]) // n_envs
    record_in_monitors(states.monitors, Episodes.of(ended), n_done)
    states.write()
    return Episodes.of(ended[_are_first(ended["env"], wanted)])


def _n_missing(envs: Ints, wanted: Ints) -> int:
    """The number of wanted episodes that have not ended yet."""
    return int((wanted - np.bincount(envs, minlength=len(wanted))).clip(0).sum())


def _are_first(envs: Ints, wanted: Ints) -> Bools:
    """Which episodes are among the first ``wanted`` of their environment."""
    chosen = np.zeros(len(envs), dtype=np.bool_)
    for i, n_episodes in enumerate(wanted):
        chosen[np.flatnonzero(envs == i)[:n_episodes]] = True
    return chosen
