"""Trains an agent of the library on the compiled loop, and keeps the rest from noticing."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from agents.common.callback_horizons import (
    EpisodeBudget,
    Horizon,
    horizon,
    members,
    wants_position,
)
from agents.compiled.engine import CompiledEngine
from agents.compiled.env_state import COMPENSATED_SUM
from agents.compiled.episodes import Episodes
from agents.compiled.greedy_play import Playground
from agents.compiled.learning_algorithm import compiled_schedule
from agents.compiled.loop import learn_from_last_step, run_block
from agents.networks.network_training import NetworkTraining
from agents.networks.network_worlds import NetworkEnvStates, network_playground
from agents.networks.rollout_events import RolloutEvents

# Between two blocks signals are seen to, and displays move.
SECONDS_PER_BLOCK = 0.2


class NetworkEngine(CompiledEngine):
    """One call of ``learn`` on the compiled loop.

    Args:
        training: the agent, as it and compiled code share it.
        world: the compiled counterpart of its environments.
        callback: what is told of the steps.
        log_interval: episodes between two log records, or rollouts, or None.
    """

    counts_where_stopped = False  # as in the library

    states: NetworkEnvStates

    def __init__(
        self,
        training: NetworkTraining,
        world: Any,
        callback: BaseCallback,
        log_interval: int | None,
    ) -> None:
        self.training = training
        self.rollouts = RolloutEvents(training.agent, callback)
        training.waits = self.rollouts.are_heeded
        self.steps_at_once = 1
        self.has_begun = False
        self.in_loop = training.in_loop()
        # Where rollouts are of a fixed length, episodes to train for do not move schedules.
        self.total_timesteps = training.agent._total_timesteps
        super().__init__(training.agent, world, callback, log_interval)

    def _make_states(self) -> NetworkEnvStates:
        return NetworkEnvStates(self.agent.env, self.world, self.training.seen)

    def _playground(self, vec_env: VecEnv) -> Playground:
        return network_playground(vec_env)

    def _learner(self) -> Any:
        """The agent as compiled functions see it, also after a callback has changed it."""
        for name, schedule in self.training.schedules().items():
            self.progress[0][f"{name}_schedule"] = compiled_schedule(schedule)
        self.training.read_settings()
        self._take_generators()
        return self.in_loop

    def _is_over(self, total_timesteps: int) -> bool:
        # As in the library, what is being collected is collected to its end.
        return self.training.until_end(total_timesteps) <= 0

    def _run_block(self, total_timesteps: int) -> bool:
        self._begin_rollout()
        progress = self.progress[0]
        limit = self._steps_allowed(total_timesteps)
        began = time.perf_counter()
        n_steps = run_block(
            self.world,
            self._learner(),
            self.envs,
            self.handles,
            progress,
            self.log,
            limit.calls,
            limit.episodes,
            COMPENSATED_SUM,
        )
        self._note_speed(n_steps, time.perf_counter() - began)
        episodes = Episodes.of(self.log.episodes[: progress["logged_episodes"]])
        if not self._tell(episodes, n_steps):
            # As in the library, the last step is not learnt from, nor what belongs to it.
            self.training.give_up_rollout()
            return False
        self._learn_from_last(episodes, n_steps)
        self.rollouts.end_block()
        return True

    def _learn_from_last(self, episodes: Episodes, n_steps: int) -> None:
        training, progress = self.training, self.progress[0]
        if not training.waits:
            training.before_training(self.log_interval)
        learn_from_last_step(self._learner(), self.envs, progress)
        last_step = int(np.searchsorted(episodes.steps, n_steps - 1))
        self._take_over_counts(1, len(episodes.envs) - last_step)
        if training.waits and training.is_rollout_over:
            self.rollouts.end()
            training.before_training(self.log_interval)
            self._learner()
            training.learn_from_rollout(float(progress["remaining"]))
            self._take_over_counts(0, 0)
        training.record()

    def _record_earlier(self) -> None:
        self.training.record()

    def _begin_rollout(self) -> None:
        if not self.has_begun:
            # Callbacks have been told already.
            self.has_begun = True
        elif wants_position(self.callback):
            self._write()
            self.rollouts.begin()
            self._read()
        else:
            self.rollouts.begin()

    def _steps_allowed(self, total_timesteps: int) -> Horizon:
        """How far to go until somebody has to be asked."""
        agent = self.agent
        ahead, log = horizon(self.callback), self.training.until_log(self.log_interval)
        left = self.training.until_end(total_timesteps)
        over = self.training.until_rollout_end()
        steps = min(ahead.calls, log.calls, over.calls, left, self.block_steps, self.steps_at_once)
        self.progress[0]["episodes"] = getattr(agent, "_episode_num", 0)
        return Horizon(max(steps, 1), min(ahead.episodes, log.episodes, over.episodes))

    def _note_speed(self, n_steps: int, seconds: float) -> None:
        """Adapt how many steps a block may have; results do not depend on that."""
        fitting = n_steps * SECONDS_PER_BLOCK / max(seconds, 1e-6)
        self.steps_at_once = max(1, min(int(fitting), 4 * self.steps_at_once))

    def _take_over_counts(self, n_steps: int, n_episodes: int) -> None:
        self.training.take_over_progress(float(self.progress[0]["remaining"]))
        self._take_over_position()
        if n_episodes:
            self.training.count_episodes(n_episodes, self.log_interval)

    def _take_over_position(self) -> None:
        self.agent._last_obs = self.states.observations(self.envs, "")
        self.training.write()

    def _read(self) -> None:
        agent, progress = self.agent, self.progress[0]
        progress["num_timesteps"] = agent.num_timesteps
        progress["total_timesteps"] = self.total_timesteps
        if self.training.heeds_budgets:
            progress["total_timesteps"] = agent._total_timesteps
            for budget in members(self.callback):
                if isinstance(budget, EpisodeBudget):
                    progress["episode_budget"] = budget.n_episodes
                    progress["budget_episodes"] = budget.episodes_seen
        progress["remaining"] = agent._current_progress_remaining
        self.training.read()
        self.states.read()
        self.states.take_observations(agent._last_obs)
