"""Drives the compiled loop, and keeps the rest of the training from noticing.

Before a run the state of the environments is read into arrays; after it, it is written back, so
that what comes next, interpreted or compiled, goes on from the same place.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.common.callback_horizons import EpisodeBudget, horizon, members, pass_over
from agents.common.exploration import STRATEGIES, draws_per_choice
from agents.common.schedules import schedule_row
from agents.compiled.interrupts import interrupts_held
from agents.compiled.random_streams import UniformStreams
from agents.tabular import rollout
from agents.tabular.episodes import Episodes, record_in_monitors
from agents.tabular.records import ENV, EPISODE, PROGRESS, Learner
from agents.tabular.simulator import CART_POLE, MAX_DRAWS_PER_STEP, World
from agents.tabular.stepping import add_to_return
from agents.tabular.worlds import layers, monitor_of

if TYPE_CHECKING:
    from agents.tabular.base import TabularAlgorithm

CART_POLE_FIELDS = ("x", "x_dot", "theta", "theta_dot")
MAX_BLOCK_STEPS = 65_536

# Python's sum of floats makes up for rounding from this version on.
COMPENSATED_SUM = sys.version_info >= (3, 12)


class CompiledEngine:
    """One call of ``learn`` on the compiled loop.

    Args:
        agent: the algorithm, whose tables and generator are used in place.
        world: the compiled counterpart of its environments.
        callback: what is told of the steps.
        log_interval: episodes between two log records, or None.
    """

    def __init__(
        self,
        agent: TabularAlgorithm,
        world: World,
        callback: BaseCallback,
        log_interval: int | None,
    ) -> None:
        assert isinstance(agent.env, DummyVecEnv)
        self.agent = agent
        self.world = world
        self.callback = callback
        self.log_interval = log_interval
        self.vec_env = agent.env
        self.monitors = [monitor_of(env) for env in agent.env.envs]
        self.unfinished: list[list[NDArray[np.float64]]] = [[] for _ in agent.env.envs]
        self.reports_success = ["is_success" in (info or {}) for info in agent.env.reset_infos]
        self.block_steps = max(MAX_BLOCK_STEPS // agent.n_envs, 1)
        # A finite model takes one for the step and one for a reset, CartPole four for a reset.
        self.draws_per_step = MAX_DRAWS_PER_STEP if world.kind == CART_POLE else 2
        self.streams = UniformStreams(
            [env.unwrapped.np_random for env in agent.env.envs],
            self.draws_per_step * self.block_steps,
        )
        self.budget = next((m for m in members(callback) if isinstance(m, EpisodeBudget)), None)
        self.learner = _learner(agent, self.budget)
        self.envs = np.zeros(agent.n_envs, dtype=ENV)
        self.progress = np.zeros(1, dtype=PROGRESS)
        self.log = np.zeros(self.block_steps * agent.n_envs, dtype=EPISODE)
        self.rewards = np.empty((self.block_steps, agent.n_envs))
        tables = agent.policy.q_tables.numpy()
        n_draws = draws_per_choice(self.learner.strategy, tables.shape[2])
        # What acting and learning have in common, in the order of their arguments.
        self.learning = (
            tables,
            agent.policy.visit_counts.numpy(),
            agent.rng,
        )
        self.room = (np.empty(n_draws), np.zeros(agent.n_envs), np.empty(tables.shape[2]))
        self._read_state()

    def run(self, total_timesteps: int) -> None:
        """Train until ``num_timesteps`` reaches ``total_timesteps`` or a callback stops it."""
        with interrupts_held() as interrupted:
            try:
                while self.agent.num_timesteps < total_timesteps:
                    if not self._run_block(total_timesteps) or interrupted():
                        break
            finally:
                self._write_state()

    def _run_block(self, total_timesteps: int) -> bool:
        agent = self.agent
        self.callback.on_rollout_start()
        ahead = horizon(self.callback)
        steps_left = -(-(total_timesteps - agent.num_timesteps) // agent.n_envs)
        most_steps = min(ahead.calls, steps_left, self.block_steps)
        self.streams.refill(self.draws_per_step * most_steps)
        self.envs["uniforms_used"] = self.streams.used
        episodes_to_log = (
            ahead.episodes
            if self.log_interval is None
            else self.log_interval - agent._episode_num % self.log_interval
        )
        n_steps = rollout.run_block(
            self.world,
            self.learner,
            self.envs,
            self.progress[0],
            *self.learning,
            self.streams.uniforms,
            *self.room,
            self.log,
            self.rewards,
            most_steps,
            min(ahead.episodes, episodes_to_log),
            COMPENSATED_SUM,
        )
        self.streams.used[:] = self.envs["uniforms_used"]
        episodes = Episodes.of(self.log[: self.progress[0]["logged_episodes"]])
        keep_going = self._tell(episodes, n_steps)
        rollout.learn_from_step(
            self.learner, self.envs, self.progress[0], *self.learning, *self.room
        )
        last_step = int(np.searchsorted(episodes.steps, n_steps - 1))
        self._take_over_counts(1, len(episodes.envs) - last_step)
        self.callback.on_rollout_end()
        return keep_going

    def _tell(self, episodes: Episodes, n_steps: int) -> bool:
        """Monitor, statistics and callbacks; False once a callback asks to stop."""
        agent = self.agent
        self._keep_unfinished_rewards(episodes, n_steps)
        times = record_in_monitors(self.monitors, episodes)
        for monitor in self.monitors:
            if monitor is not None:
                monitor.total_steps += n_steps
        # The statistics hear of the last step after the callbacks, as in the interpreted loop.
        earlier = int(np.searchsorted(episodes.steps, n_steps - 1))
        self._update_statistics(episodes, 0, earlier, times)
        agent.num_timesteps += n_steps * agent.n_envs
        # Callbacks come before the last step is learnt from: until then the counters end before it.
        self._take_over_counts(n_steps - 1, earlier)
        pass_over(self.callback, n_steps - 1, earlier)
        local = self._last_step(episodes, earlier, times)
        self.callback.update_locals(local)
        keep_going = self.callback.on_step()
        self._update_statistics(episodes, earlier, len(episodes.envs), times)
        return keep_going

    def _update_statistics(
        self, episodes: Episodes, start: int, stop: int, times: list[float]
    ) -> None:
        agent = self.agent
        assert agent.ep_info_buffer is not None
        assert agent.ep_success_buffer is not None
        remembered = slice(max(start, stop - agent._stats_window_size), stop)
        if self.monitors[0] is not None:
            agent.ep_info_buffer.extend(episodes.infos(remembered, times))
        if self.reports_success[0]:
            agent.ep_success_buffer.extend(episodes.successes[remembered].tolist())

    def _last_step(self, episodes: Episodes, earlier: int, times: list[float]) -> dict[str, Any]:
        """What callbacks read of the last step, under the names of the interpreted loop."""
        envs = self.envs
        infos: list[dict[str, Any]] = [
            {"TimeLimit.truncated": bool(done and not terminated)}
            for done, terminated in zip(envs["done"], envs["terminated"], strict=True)
        ]
        last = slice(earlier, None)
        for env, info in zip(
            episodes.envs[last].tolist(), episodes.infos(last, times), strict=True
        ):
            infos[env].update(episode=info, terminal_observation=int(envs["next_obs"][env]))
        return {
            "actions": envs["action"].copy(),
            "new_obs": envs["new_obs"].copy(),
            "rewards": envs["reward"].astype(np.float32),
            "dones": envs["done"].copy(),
            "infos": infos,
        }

    def _take_over_counts(self, n_steps: int, n_episodes: int) -> None:
        """Let the algorithm's own counters follow, and log where it is time to."""
        agent, progress = self.agent, self.progress[0]
        agent._current_progress_remaining = float(progress["remaining"])
        agent.mean_td_error = float(progress["mean_td_error"])
        agent._n_updates += n_steps * agent.n_envs
        self._take_over_position()
        if n_episodes:
            agent._count_episodes(n_episodes, self.log_interval)

    def _take_over_position(self) -> None:
        self.agent._last_obs = self.envs["obs"].copy()
        self.agent._next_actions = self.envs["next_action"].copy()

    def _keep_unfinished_rewards(self, episodes: Episodes, n_steps: int) -> None:
        """Monitor holds the rewards of the episode that is under way: so must we."""
        for i in range(self.agent.n_envs):
            ends = episodes.steps[episodes.envs == i]
            if len(ends):
                self.unfinished[i] = []
            first = int(ends[-1]) + 1 if len(ends) else 0
            if first < n_steps:
                self.unfinished[i].append(self.rewards[first:n_steps, i].copy())

    def _read_state(self) -> None:
        """Take over the state of agent and environments."""
        agent = self.agent
        self.progress["num_timesteps"] = agent.num_timesteps
        self.progress["total_timesteps"] = agent._total_timesteps
        self.progress["remaining"] = agent._current_progress_remaining
        self.progress["episodes"] = agent._episode_num
        self.progress["budget_episodes"] = 0 if self.budget is None else self.budget.episodes_seen
        self.progress["mean_td_error"] = agent.mean_td_error
        self.envs["obs"] = agent._last_obs
        self.envs["next_action"] = agent._next_actions
        for i, env in enumerate(self.vec_env.envs):
            self._read_env(i, env)

    def _read_env(self, i: int, env: gym.Env[Any, Any]) -> None:
        base: Any = env.unwrapped
        record = self.envs[i]
        if self.world.kind == CART_POLE:
            for name, value in zip(CART_POLE_FIELDS, base.state, strict=True):
                record[name] = value
        else:
            record["state"] = base.s
        record["elapsed"] = _elapsed_steps(env)
        monitor = self.monitors[i]
        if monitor is not None:
            for reward in monitor.rewards:
                add_to_return(record, reward, COMPENSATED_SUM)
            self.unfinished[i] = [np.array(monitor.rewards)] if monitor.rewards else []

    def _write_state(self) -> None:
        """Put agent and environments where the arrays are."""
        self.streams.give_back()
        self._take_over_position()
        for i, env in enumerate(self.vec_env.envs):
            self._write_env(i, env)

    def _write_env(self, i: int, env: gym.Env[Any, Any]) -> None:
        record = self.envs[i]
        base: Any = env.unwrapped
        if self.world.kind == CART_POLE:
            base.state = np.array([record[name] for name in CART_POLE_FIELDS])
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
                chunks = self.unfinished[i]
                layer.rewards = np.concatenate(chunks).tolist() if chunks else []
                layer.needs_reset = False
        next(iter(self.vec_env.buf_obs.values()))[i] = record["obs"]


def _learner(agent: TabularAlgorithm, budget: EpisodeBudget | None) -> Learner:
    exploration = schedule_row(agent.exploration_schedule)
    learning_rate = schedule_row(agent.lr_schedule)
    assert exploration is not None
    assert learning_rate is not None
    return Learner(
        rule=agent.rule,
        strategy=STRATEGIES[agent.exploration],
        gamma=float(agent.gamma),
        tie_scale=float(agent.tie_breaking == "random"),
        sample_average=agent.averages_samples,
        skip_terminal_update=bool(agent.skip_terminal_update),
        exploration=exploration,
        learning_rate=learning_rate,
        episode_budget=0 if budget is None else budget.n_episodes,
    )


def _elapsed_steps(env: gym.Env[Any, Any]) -> int:
    """Steps of the episode under way, by whichever counter knows them."""
    for layer in layers(env):
        if isinstance(layer, TimeLimit):
            return int(vars(layer)["_elapsed_steps"] or 0)
        if isinstance(layer, Monitor):
            return len(layer.rewards)
    return 0
