"""Copies environments' states to and from compiled records, and plays without learning."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FunctionType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common import callbacks as library_callbacks
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EventCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from rl_yardstick.agents.common.callbacks import members
from rl_yardstick.agents.compiled.generators import handles_of
from rl_yardstick.agents.compiled.loop import (
    EpisodeLog,
    act,
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
    RECORD,
    STATE,
    UNDECIDED,
    CartPole,
    FiniteModel,
    MountainCar,
    NotCompilable,
    World,
    draws_alike,
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
# same state. `EvalCallback`s of a compiled training use them.

# Some hundredths of a second with networks, for which a signal may have to wait.
STEPS_AT_ONCE = 4096

# The library's warning about an evaluation without Monitor.
UNMONITORED = (
    "Evaluation environment is not wrapped with a ``Monitor`` wrapper. "
    "This may result in reporting modified episode lengths and rewards, if other wrappers happen "
    "to modify these. Consider wrapping environment first with ``Monitor`` wrapper."
)

# A callback with one of these attributes overridden keeps its own evaluation.
_HOOKS = {"_on_step", "_log_success_callback"}

# A compiled environment, the states of the originals, and how to read its observations.
Playground = tuple[Any, EnvStates, Any]


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


class Explorer(NamedTuple):
    """A player that acts like the agent at one moment of its training."""

    agent: Any  # the agent for compiled functions, with another generator
    progress: Any  # the training's progress: an array of one `PROGRESS` record

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Choose a new action; no earlier choice is kept."""
        env.next_action = UNDECIDED
        act(self.agent, env, self.progress[0])

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
        np.zeros(0, dtype=RECORD),
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


class CompiledEvaluations:
    """Runs the evaluations of each `EvalCallback` of a training in compiled code.

    The callback's own code runs, with `evaluate_policy` replaced by the method of this class. The
    library's function still runs for the rest: environments or agents that are not compiled bit
    for bit; networks that draw actions, because PyTorch's generator draws them; and rendering on
    the screen.
    """

    def __init__(
        self, agent: Any, callback: BaseCallback, playground: Callable[[VecEnv], Playground]
    ) -> None:
        self.agent = agent
        self.playground = playground
        self.callbacks = list(_evaluating(callback))
        self.refused: list[VecEnv] = []
        on_step: Any = EvalCallback._on_step
        names = {**on_step.__globals__, "evaluate_policy": self.evaluate_policy}
        self.on_step: Any = FunctionType(on_step.__code__, names, closure=on_step.__closure__)

    @contextmanager
    def taking_over(self) -> Iterator[None]:
        """Make the callbacks evaluate in compiled code within the ``with`` statement."""
        for callback in self.callbacks:
            vars(callback)["_on_step"] = partial(self.on_step, callback)
        try:
            yield
        finally:
            for callback in self.callbacks:
                del vars(callback)["_on_step"]

    def evaluate_policy(self, model: Any, env: VecEnv, **given: Any) -> Any:
        """Replace the library's function, with the arguments that `EvalCallback` gives it."""
        playground = None if given["render"] else self._playground(model, env)
        player = self._player(given["deterministic"], playground)
        if playground is None or player is None:
            return evaluate_policy(model, env, **given)
        world, states, _ = playground
        is_monitored = states.monitors[0] is not None
        if given["warn"] and not is_monitored:
            warnings.warn(UNMONITORED, stacklevel=1)
        observations = env.reset()
        wanted = (given["n_eval_episodes"] + np.arange(env.num_envs)) // env.num_envs
        found = play_episodes(world, player, states, observations, wanted)
        if "is_success" in (env.reset_infos[0] or {}):
            for success in found.successes.tolist():
                given["callback"]({"done": True, "info": {"is_success": success}}, {})
        if not is_monitored:
            return list(found.returns), list(found.lengths)
        infos = found.infos(slice(None), [0.0] * env.num_envs)
        return [info["r"] for info in infos], [info["l"] for info in infos]

    def _playground(self, model: Any, env: VecEnv) -> Playground | None:
        """The compiled environments, if they draw and count exactly as in Python; else None."""
        of_agent = (self.agent.observation_space, self.agent.action_space)
        if model is not self.agent or of_agent != (env.observation_space, env.action_space):
            return None
        if any(env is refused for refused in self.refused):
            return None
        try:
            world, states, seen = self.playground(env)
        except NotCompilable:
            self.refused.append(env)
            return None
        ours = {id(each.unwrapped) for each in self.agent.env.envs}
        if any(id(each.unwrapped) in ours for each in states.vec_env.envs):
            return None
        is_alike = draws_alike(states.vec_env) and _counts(world, states)
        return (world, states, seen) if is_alike else None

    def _player(self, deterministic: bool, playground: Playground | None) -> Any:
        """The compiled counterpart of the agent's `predict`; None if it cannot be compiled."""
        name = "greedy_player" if deterministic else "exploring_player"
        make = getattr(self.agent, name, None)
        if playground is None or make is None or not _predicts_as_ours(self.agent):
            return None
        return make(playground[2])


def _evaluating(callback: BaseCallback) -> Iterator[EvalCallback]:
    """The unchanged `EvalCallback`s among the callbacks and the callbacks that they trigger."""
    if library_callbacks.evaluate_policy is not evaluate_policy:  # type: ignore[attr-defined]
        return
    for member in members(callback):
        if type(member) is EvalCallback and not _HOOKS & vars(member).keys():
            yield member
        elif isinstance(member, EventCallback) and member.callback is not None:
            yield from _evaluating(member.callback)


def _predicts_as_ours(agent: Any) -> bool:
    """Whether agent and policy still have the `predict` of this project or the library."""
    asked = ((agent, "predict"), (agent.policy, "predict"), (agent.policy, "_predict"))
    modules = [getattr(type(thing), name).__module__ for thing, name in asked]
    known = all(
        module.partition(".")[0] in ("rl_yardstick", "stable_baselines3") for module in modules
    )
    return known and not any(name in vars(thing) for thing, name in asked)


def _counts(world: Any, states: EnvStates) -> bool:
    """Whether compiled returns equal the library's to the last bit.

    Without Monitor, the library adds the agent's rewards in single precision: the sum is the same
    if all rewards are integers.
    """
    monitored = [monitor is not None for monitor in states.monitors]
    if any(monitored):
        return all(monitored)
    if not isinstance(world, FiniteModel):
        return True
    rewards = world.outcomes["reward"]
    return bool((rewards == np.rint(rewards)).all() and np.abs(rewards).max() < 2**24)
