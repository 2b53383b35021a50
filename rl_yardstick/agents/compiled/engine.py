"""Chooses between compiled and interpreted training, and drives the compiled loop."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from rl_yardstick.agents.common.callbacks import (
    BlockCallback,
    EpisodeBudget,
    Horizon,
    horizon,
    members,
    pass_over,
    unknown_callbacks,
)
from rl_yardstick.agents.compiled.env_states import (
    COMPENSATED_SUM,
    DECIMALS,
    EnvStates,
    Episodes,
    observed_world,
    record_in_monitors,
)
from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm, compiled_schedule
from rl_yardstick.agents.compiled.loop import EpisodeLog, learn_from_last_step, run_block
from rl_yardstick.agents.compiled.worlds import (
    EPISODE,
    PROGRESS,
    NotCompilable,
    draws_alike,
    monitor_of,
)
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Ints

# A block takes some hundredths of a second, for which a signal may have to wait. The log has at
# most one record of each block.
MAX_BLOCK_STEPS = 262_144


class CompiledEngine:
    """One call of ``learn`` on the compiled loop."""

    # Whether statistics include the step on which a callback ends training.
    counts_where_stopped = True

    def __init__(
        self, agent: Any, world: tuple[Any, Any], callback: BaseCallback, log_interval: int | None
    ) -> None:
        assert isinstance(agent.env, DummyVecEnv)
        self.agent = agent
        self.world, self.seen = world
        self.callback = callback
        self.log_interval = log_interval
        self.reports_success = ["is_success" in (info or {}) for info in agent.env.reset_infos]
        self.block_steps = max(MAX_BLOCK_STEPS // agent.n_envs, 1)
        self.states = EnvStates(agent.env, self.world, self.seen)
        self.envs = self.states.records
        self.progress = np.zeros(1, dtype=PROGRESS)
        self.log = EpisodeLog(
            np.zeros(self.block_steps * agent.n_envs, dtype=EPISODE),
            np.empty((self.block_steps, agent.n_envs)),
        )
        self.made_from: tuple[Any, ...] = ()
        self.learner: Any = None
        self._read()

    def _learner(self) -> Any:
        """The agent for compiled functions, updated after changes by callbacks."""
        agent, progress = self.agent, self.progress[0]
        made_from = agent.made_from(agent.rng)
        if made_from != self.made_from:
            self.made_from, self.learner = made_from, agent.compiled_agent(agent.rng, self.seen)
        for name, schedule in agent.schedules().items():
            progress[f"{name}_schedule"] = compiled_schedule(schedule)
            progress[name] = schedule(agent._current_progress_remaining)
        return self.learner

    def run(self, total_timesteps: int) -> None:
        """Train until ``num_timesteps`` reaches ``total_timesteps`` or a callback stops it."""
        try:
            while self._steps_left(total_timesteps) > 0 and self._run_block(total_timesteps):
                pass
        finally:
            self._write()

    def _steps_left(self, total_timesteps: int) -> int:
        """Steps of every environment until the training is over."""
        left: int = total_timesteps - self.agent.num_timesteps
        return -(-left // int(self.agent.n_envs))

    def _run_block(self, total_timesteps: int) -> bool:
        """Train for a block of steps; False once a callback asks to stop."""
        self._begin_block()
        self.progress[0]["episodes"] = self.agent._episode_num
        n_logged = self._log_count
        n_steps = self._step(self._limit(total_timesteps))
        episodes = Episodes.of(self.log.episodes[: self.progress[0]["logged_episodes"]])
        earlier = int(np.searchsorted(episodes.steps, n_steps - 1))
        keep_going = self._tell(episodes, n_steps, earlier)
        self._learn_from_last(len(episodes.envs) - earlier, keep_going)
        interval = self.log_interval
        if interval is not None and self._log_count // interval > n_logged // interval:
            self._write_log()
        self.callback.on_rollout_end()
        return keep_going

    def _begin_block(self) -> None:
        """Call the callbacks, with environments up to date if one of them asks for that."""
        known = (m for m in members(self.callback) if isinstance(m, BlockCallback))
        if any(member.wants_position() for member in known):
            self._write()
            self.callback.on_rollout_start()
            self._read()
        else:
            self.callback.on_rollout_start()

    def _limit(self, total_timesteps: int) -> Horizon:
        """The number of steps and episodes until the block must end."""
        ahead, left = horizon(self.callback), self._steps_left(total_timesteps)
        return Horizon(min(ahead.calls, left, self.block_steps), ahead.episodes)

    def _step(self, limit: Horizon) -> int:
        """Act and learn in compiled code, but for the last step; returns the number of steps."""
        self.states.take_generators()  # a callback may have reseeded the environments
        return run_block(
            self.world,
            self._learner(),
            self.envs,
            self.states.handles,
            self.progress[0],
            self.log,
            limit.calls,
            limit.episodes,
            COMPENSATED_SUM,
        )

    def _learn_from_last(self, n_episodes: int, keep_going: bool) -> None:
        """Learn from the last step, at which ``n_episodes`` ended."""
        learn_from_last_step(self._learner(), self.envs, self.progress[0])
        self._take_over_counts(1, n_episodes)

    @property
    def _log_count(self) -> int:
        """The count by which the log is due."""
        return int(self.agent._episode_num)

    def _write_log(self) -> None:
        self.agent.dump_logs()

    def _tell(self, episodes: Episodes, n_steps: int, earlier: int) -> bool:
        """Update Monitor, statistics and callbacks; False once a callback asks to stop.

        The first ``earlier`` episodes ended before the last step.
        """
        agent = self.agent
        self.states.keep_rewards(episodes, self.log.rewards[:n_steps])
        times = record_in_monitors(self.states.monitors, episodes, n_steps)
        # As in the interpreted loop, the statistics get the last step after the callbacks.
        self._update_statistics(episodes, 0, earlier, times)
        agent.num_timesteps += n_steps * agent.n_envs
        # Callbacks run before the agent learns from the last step, so the counters exclude it yet.
        self._take_over_counts(n_steps - 1, earlier)
        pass_over(self.callback, n_steps - 1, earlier)
        self.callback.update_locals(self._last_step(episodes, earlier, times))
        keep_going = self.callback.on_step()
        if keep_going or self.counts_where_stopped:
            self._update_statistics(episodes, earlier, len(episodes.envs), times)
        return keep_going

    def _update_statistics(
        self, episodes: Episodes, start: int, stop: int, times: list[float]
    ) -> None:
        agent = self.agent
        remembered = slice(max(start, stop - agent._stats_window_size), stop)
        if self.states.monitors[0] is not None:
            agent.ep_info_buffer.extend(episodes.infos(remembered, times))
        if self.reports_success[0]:
            agent.ep_success_buffer.extend(episodes.successes[remembered].tolist())

    def _last_step(self, episodes: Episodes, earlier: int, times: list[float]) -> dict[str, Any]:
        """The last step's values for callbacks, under the names of the interpreted loop."""
        envs = self.envs
        infos: list[dict[str, Any]] = [
            {"TimeLimit.truncated": bool(done and not terminated)}
            for done, terminated in zip(envs["done"], envs["terminated"], strict=True)
        ]
        last, ends = slice(earlier, None), self.states.observations(envs, "next_")
        for env, info in zip(
            episodes.envs[last].tolist(), episodes.infos(last, times), strict=True
        ):
            infos[env].update(episode=info, terminal_observation=ends[env])
        return {
            "actions": envs["action"].copy(),
            "new_obs": self.states.observations(envs, "new_"),
            "rewards": envs["reward"].astype(np.float32),
            "dones": envs["done"].copy(),
            "infos": infos,
        }

    def _take_over_counts(self, n_steps: int, n_episodes: int) -> None:
        """Update the algorithm's own counters."""
        agent = self.agent
        agent._current_progress_remaining = float(self.progress[0]["remaining"])
        agent._n_updates += n_steps * agent.n_envs
        agent._episode_num += n_episodes
        self._take_over_position()

    def _take_over_position(self) -> None:
        self.agent._last_obs = self.states.observations(self.envs, "")
        self.agent.take_over(self.envs, self.progress)

    def _write(self) -> None:
        """Copy the records into the state of agent and environments."""
        self._take_over_position()
        self.states.write()

    def _read(self) -> None:
        """Copy the state of agent and environments into the records."""
        agent, progress = self.agent, self.progress[0]
        budgets = (m for m in members(self.callback) if isinstance(m, EpisodeBudget))
        for budget in budgets:
            progress["episode_budget"] = budget.n_episodes
            progress["budget_episodes"] = budget.episodes_seen
        progress["num_timesteps"] = agent.num_timesteps
        progress["total_timesteps"] = agent._total_timesteps
        progress["remaining"] = agent._current_progress_remaining
        progress["episodes"] = agent._episode_num
        self._read_agent()
        self.states.read()
        self.states.take_observations(agent._last_obs)

    def _read_agent(self) -> None:
        self.agent.hand_over(self.envs, self.progress)


EngineChoice = Literal["auto", "compiled", "interpreted"]

# What a class may override in Python: all of it reaches compiled functions through the settings,
# schedules, tables and memory.
SETTINGS = (
    "__dict__",
    "__init__",
    "__weakref__",
    "_check_arguments",
    "_make_exploration_schedule",
    "_make_memory",
    "_make_policy",
    "_memory_in_use",
    "_policy_arguments",
    "strategy",
    "tie_scale",
    "averages_samples",
)


def choose_engine(
    agent: Any, callback: BaseCallback, log_interval: int | None
) -> CompiledEngine | None:
    """The compiled engine, if the agent asks for it and can be compiled; else None.

    If an environment draws random numbers in its own way, its compiled copy has only the same
    distribution. ``auto`` does not use such a copy, so that results do not depend on whether
    compilation was possible. ``agent.engine_in_use`` records the choice and its reason.
    """
    if agent.engine == "interpreted":
        agent.engine_in_use = "interpreted: asked for"
        return None
    try:
        check_class(type(agent))
        if unknown := unknown_callbacks(callback):
            raise NotCompilable(f"{', '.join(unknown)} must be asked after each step")
        agent.check_compilable()
        for schedule in agent.schedules().values():
            compiled_schedule(schedule)
        world = observed_world(agent.env)
    except NotCompilable as reason:
        if agent.engine == "compiled":
            raise ValueError(f"engine: compiled is not possible: {reason}") from None
        agent.engine_in_use = f"interpreted: {reason}"
        return None
    agent.engine_in_use = "compiled"
    if not draws_alike(agent.env):
        if agent.engine == "auto":
            agent.engine_in_use = (
                "interpreted: the environment draws in its own way. Compiled training would be "
                "equal in distribution only (engine: compiled accepts that)"
            )
            return None
        agent.engine_in_use = "compiled, not bit for bit: the environment draws in its own way"
    return CompiledEngine(agent, world, callback, log_interval)


def check_class(algorithm: type) -> None:
    """Check that no Python method of the algorithm replaces a compiled part of a step."""
    order = algorithm.__mro__
    settings: Any = algorithm.settings_type.names  # type: ignore[attr-defined]
    for place, cls in enumerate(order[: order.index(LearningAlgorithm)]):
        if cls.__module__.startswith("rl_yardstick.agents."):
            continue
        above = [vars(base) for base in order[place + 1 :] if base is not object]
        for name, value in vars(cls).items():
            in_python = hasattr(value, "__get__") and not hasattr(value, "py_func")
            replaces = any(name in names for names in above) or name in settings
            if in_python and replaces and name not in SETTINGS:
                raise NotCompilable(f"{algorithm.__name__} has a {name} of its own in Python")


# Some hundredths of a second with networks, for which a signal may have to wait.
STEPS_AT_ONCE = 4096


class Plan(NamedTuple):
    """A player with a fixed action for each observed number."""

    actions: Ints  # one for each number, shape (S,)
    seen: Any  # how observations are read

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Look the action up."""
        env.action = self.actions[env.obs]


# Environments for evaluation, their compiled counterpart, and what converts its observations.
CompiledCopy = tuple[DummyVecEnv, Any, Any]


def compiled_copy(env: VecEnv) -> CompiledCopy | None:
    """The compiled copy of CartPole or MountainCar, plain or in Monitor; None for others."""
    from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv

    if not isinstance(env, DummyVecEnv) or any(monitor_of(each) is None for each in env.envs):
        return None
    if not isinstance(env.envs[0].unwrapped, CartPoleEnv | MountainCarEnv):
        return None
    try:
        return (env, *observed_world(env))
    except NotCompilable:
        return None


def play_episodes(agent: Any, copy: CompiledCopy, n_episodes: int) -> Episodes:
    """Reset the environments and play episodes, as many in each as `evaluate_policy` would.

    All environments step until each has ended its number of episodes. The environments, their
    generators and their Monitors end in the state in which `evaluate_policy` would leave them.
    Returns are rounded as in Monitor.
    """
    env, world, seen = copy
    n_envs, player = env.num_envs, agent.greedy_player(seen)
    wanted = (n_episodes + np.arange(n_envs)) // n_envs
    observations = env.reset()
    states, progress = EnvStates(env, world, seen), np.zeros(1, dtype=PROGRESS)
    states.read()
    states.take_observations(observations)
    log = EpisodeLog(
        np.zeros(STEPS_AT_ONCE * n_envs, dtype=EPISODE), np.empty((STEPS_AT_ONCE, n_envs))
    )
    ended: Any = np.zeros(0, dtype=EPISODE)
    while True:
        # At least this many more episodes must end.
        n_ended = np.bincount(ended["env"], minlength=n_envs)
        if (n_missing := int((wanted - n_ended).clip(0).sum())) == 0:
            break
        limits = STEPS_AT_ONCE, n_missing, COMPENSATED_SUM
        told = world, player, states.records, states.handles, progress[0], log
        n_steps = run_block(*told, *limits)
        learn_from_last_step(player, states.records, progress[0])
        if hasattr(player, "check"):
            player.check()
        new = log.episodes[: progress["logged_episodes"][0]]
        states.keep_rewards(Episodes.of(new), log.rewards[:n_steps])
        ended = np.concatenate([ended, new])
    n_done = int(progress["num_timesteps"][0]) // n_envs
    record_in_monitors(states.monitors, Episodes.of(ended), n_done)
    states.write()
    found = Episodes.of(ended[_are_first(ended["env"], wanted)])
    found.returns[:] = [round(total, DECIMALS) for total in found.returns.tolist()]
    return found


def _are_first(envs: Ints, wanted: Ints) -> Bools:
    """Which episodes are among the first ``wanted`` of their environment."""
    chosen = np.zeros(len(envs), dtype=np.bool_)
    for i, n_episodes in enumerate(wanted):
        chosen[np.flatnonzero(envs == i)[:n_episodes]] = True
    return chosen
