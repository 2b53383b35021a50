"""Trains an agent of the library on the compiled loop, with the library's callbacks and logs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from rl_yardstick.agents.common.callbacks import EpisodeBudget, Horizon, horizon, members
from rl_yardstick.agents.compiled.engine import CompiledEngine
from rl_yardstick.agents.compiled.env_states import Numbers
from rl_yardstick.agents.compiled.generators import handles_of
from rl_yardstick.agents.compiled.learning_algorithm import compiled_schedule
from rl_yardstick.agents.compiled.references import Reference, address_of
from rl_yardstick.agents.networks.torch_bridge import FlatTensors, SharedOptimizer

# A placeholder of an address, until there is a reference to the learner.
NOWHERE = np.uintp(0)


class NetworkTraining:
    """An agent of the library in training, with its networks in the memory of compiled code.

    The base of `QTraining` and `PolicyTraining`, which make the learner.
    """

    held: Any  # the learner for compiled functions
    learner: Reference  # the same by reference

    def __init__(self, agent: Any, seen: Any) -> None:
        self.agent = agent
        self.seen = seen  # how to read observations of compiled environments
        # Kept here, because its handle does not keep it alive.
        self.generator = agent.rng
        self.networks, lagging = agent.shared_networks(seen)
        self.trained, self.lagging = FlatTensors(self.networks), FlatTensors(lagging)
        self.trained.take_over()
        self.lagging.take_over()
        self.optimizer = SharedOptimizer(agent.policy, self.networks)
        # Observations of environments in Python.
        width = 1 if isinstance(seen, Numbers) else int(self.networks[0].layers.sizes[0])
        self.shown = np.zeros((agent.n_envs, width))

    def close(self) -> None:
        """Give networks and optimizer their own memory again."""
        for part in (self.trained, self.lagging, self.optimizer):
            part.give_back()

    def begin(self, held: Any, improve: Callable[[Any, float, float], int]) -> None:
        """Set the learner, and its compiled function that learns from a minibatch."""
        self.learner = Reference(held)
        self.held = held._replace(improve=address_of(improve, self.learner))
        self.learner.hold(self.held)

    def read_tensors(self) -> None:
        """Use weights that a callback may have replaced."""
        self.trained.take_over()
        self.lagging.take_over()

    def read_generator(self) -> None:
        """Use the agent's generator, which a callback may have replaced."""
        if self.agent.rng is not self.generator:
            self.generator = self.agent.rng
            self.held.rng[:] = handles_of([self.generator])

    def show(self, observations: Any) -> None:
        """Copy and check observations of environments in Python."""
        self.shown[:] = np.reshape(observations, self.shown.shape)
        self.check_numbers(self.shown)

    def check_numbers(self, shown: Any) -> None:
        """Raise ValueError for numbers of states outside their space."""
        if isinstance(self.seen, Numbers) and not (shown.min() >= 0 and shown.max() < self.seen.n):
            wrong = int(shown[(shown < 0) | (shown >= self.seen.n)][0])
            raise ValueError(f"observation {wrong} is not in {self.agent.observation_space}")

    def until_end(self, total_timesteps: int) -> int:
        """Steps of every environment until the training is over."""
        left: int = total_timesteps - self.agent.num_timesteps
        return -(-left // int(self.agent.n_envs))


def record_of(kind: np.dtype[np.void], **values: Any) -> Any:
    """An array of shape (1,) with one record."""
    records = np.zeros(1, dtype=kind)
    for name, value in values.items():
        records[name] = value
    return records


# Between two blocks Python handles signals, and displays are updated.
SECONDS_PER_BLOCK = 0.2


class NetworkEngine(CompiledEngine):
    """One call of ``learn`` on the compiled loop."""

    counts_where_stopped = False  # as in the library

    def __init__(
        self,
        training: Any,  # a `QTraining` or a `PolicyTraining`
        world: Any,
        callback: BaseCallback,
        log_interval: int | None,
    ) -> None:
        self.training = training
        self.steps_at_once = 1
        self.has_begun = False
        self.in_loop = training.in_loop()
        # With rollouts of a fixed length, a budget of episodes does not change schedules.
        self.total_timesteps = training.agent._total_timesteps
        super().__init__(training.agent, (world, training.seen), callback, log_interval)

    def _learner(self) -> Any:
        for name, schedule in self.agent.schedules().items():
            self.progress[0][f"{name}_schedule"] = compiled_schedule(schedule)
        self.training.read_settings()
        self._take_generators()
        return self.in_loop

    def _is_over(self, total_timesteps: int) -> bool:
        # As in the library, the current rollout is collected to its end.
        return bool(self.training.until_end(total_timesteps) <= 0)

    def _begin_block(self) -> None:
        if self.has_begun:
            super()._begin_block()
        # Before the first block, callbacks have been called already.
        self.has_begun = True

    def _limit(self, total_timesteps: int) -> Horizon:
        ahead, log = horizon(self.callback), self.training.until_log(self.log_interval)
        left = self.training.until_end(total_timesteps)
        steps = min(ahead.calls, log.calls, left, self.block_steps, self.steps_at_once)
        return Horizon(max(steps, 1), min(ahead.episodes, log.episodes))

    def _step(self, limit: Horizon) -> int:
        began = time.perf_counter()
        n_steps = super()._step(limit)
        # Adapt the maximal length of a block; results do not depend on it.
        fitting = n_steps * SECONDS_PER_BLOCK / max(time.perf_counter() - began, 1e-6)
        self.steps_at_once = max(1, min(int(fitting), 4 * self.steps_at_once))
        return n_steps

    def _learn_from_last(self, n_episodes: int, keep_going: bool) -> None:
        if not keep_going:
            # As in the library, the agent does not learn from the last step and its rollout.
            self.training.give_up_rollout()
            return
        super()._learn_from_last(n_episodes, keep_going)
        self.training.record()

    @property
    def _log_count(self) -> int:
        return int(self.training.log_count)

    def _write_log(self) -> None:
        self.training.write_log()

    def _take_over_counts(self, n_steps: int, n_episodes: int) -> None:
        self.training.take_over_progress(float(self.progress[0]["remaining"]))
        self._take_over_position()
        if self.training.goes_by_episodes:
            self.agent._episode_num += n_episodes

    def _take_over_position(self) -> None:
        self.agent._last_obs = self.states.observations(self.envs, "")
        self.training.write()

    def _read(self) -> None:
        agent, progress = self.agent, self.progress[0]
        progress["num_timesteps"] = agent.num_timesteps
        progress["total_timesteps"] = self.total_timesteps
        if self.training.goes_by_episodes:
            progress["total_timesteps"] = agent._total_timesteps
            for budget in members(self.callback):
                if isinstance(budget, EpisodeBudget):
                    progress["episode_budget"] = budget.n_episodes
                    progress["budget_episodes"] = budget.episodes_seen
        progress["remaining"] = agent._current_progress_remaining
        self.training.read()
        self.states.read()
        self.states.take_observations(agent._last_obs)
