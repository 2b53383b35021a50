"""Trains an agent of the library on the compiled loop, with the library's callbacks and logs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.common.callbacks import (
    BlockCallback,
    EpisodeBudget,
    Horizon,
    heeds_rollouts,
    horizon,
    members,
    wants_position,
)
from rl_yardstick.agents.compiled.engine import CompiledEngine
from rl_yardstick.agents.compiled.generators import handles_of
from rl_yardstick.agents.compiled.greedy_play import COMPENSATED_SUM, Playground
from rl_yardstick.agents.compiled.learning_algorithm import compiled_schedule
from rl_yardstick.agents.compiled.loop import learn_from_last_step, run_block
from rl_yardstick.agents.compiled.records import Episodes
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.networks.network_worlds import (
    NetworkEnvStates,
    Numbers,
    network_playground,
)
from rl_yardstick.agents.networks.torch_bridge import (
    FlatTensors,
    Reference,
    SharedOptimizer,
    address_of,
)


class RolloutEvents:
    """Calls the rollout methods of a training's callbacks; a block may span several rollouts."""

    def __init__(self, agent: Any, callback: BaseCallback) -> None:
        self.agent = agent
        asked = [member for member in members(callback) if type(member) is not CallbackList]
        # For callbacks that act on rollouts, blocks must end with a rollout.
        self.of_rollouts = [member for member in asked if heeds_rollouts(member)]
        self.of_blocks = [member for member in asked if not heeds_rollouts(member)]

    @property
    def are_waited_for(self) -> bool:
        """Whether a callback acts at the end of this rollout, before the agent learns from it."""
        return any(
            not isinstance(member, BlockCallback) or member.wants_rollout_end()
            for member in self.of_rollouts
        )

    def begin(self) -> None:
        """Signal the start of a block, and of a rollout if one begins; resumed runs restore now."""
        for member in self.of_blocks:
            member.on_rollout_start()
        if not self.agent.is_within_rollout:
            for member in self.of_rollouts:
                member.on_rollout_start()

    def end(self) -> None:
        """Signal the end of a rollout, before the agent learns from it."""
        for member in self.of_rollouts:
            member.on_rollout_end()

    def end_block(self) -> None:
        """Signal the end of a block, after the agent has learnt from it."""
        for member in self.of_blocks:
            member.on_rollout_end()


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
        self.waits = False  # whether to learn by `learn_from_rollout` instead of in the loop
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
        self.held = held
        self.learner = Reference(held)
        self.hold(improve=address_of(improve, self.learner))

    def hold(self, **parts: Any) -> None:
        """Replace parts of the learner."""
        self.held = self.held._replace(**parts)
        self.learner.hold(self.held)

    def read_tensors(self) -> None:
        """Use weights and an optimizer that a callback may have replaced."""
        self.trained.take_over()
        self.lagging.take_over()
        try:
            optimizer = self.optimizer.current()
        except NotCompilable as reason:
            raise ValueError(f"engine: compiled cannot go on: {reason}") from None
        if optimizer is not self.held.optimizer:
            self.hold(optimizer=optimizer)

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

    states: NetworkEnvStates

    def __init__(
        self,
        training: Any,  # a `QTraining` or a `PolicyTraining`
        world: Any,
        callback: BaseCallback,
        log_interval: int | None,
    ) -> None:
        self.training = training
        self.rollouts = RolloutEvents(training.agent, callback)
        training.waits = self.rollouts.are_waited_for
        self.steps_at_once = 1
        self.has_begun = False
        self.in_loop = training.in_loop()
        # With rollouts of a fixed length, a budget of episodes does not change schedules.
        self.total_timesteps = training.agent._total_timesteps
        super().__init__(training.agent, world, callback, log_interval)

    def _make_states(self) -> NetworkEnvStates:
        return NetworkEnvStates(self.agent.env, self.world, self.training.seen)

    def _playground(self, vec_env: VecEnv) -> Playground:
        return network_playground(vec_env)

    def _learner(self) -> Any:
        for name, schedule in self.training.schedules().items():
            self.progress[0][f"{name}_schedule"] = compiled_schedule(schedule)
        self.training.read_settings()
        self._take_generators()
        return self.in_loop

    def _is_over(self, total_timesteps: int) -> bool:
        # As in the library, the current rollout is collected to its end.
        return bool(self.training.until_end(total_timesteps) <= 0)

    def _run_block(self, total_timesteps: int) -> bool:
        self._begin_rollout()
        self.training.waits = self.rollouts.are_waited_for
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
            # As in the library, the agent does not learn from the last step and its rollout.
            self.training.give_up_rollout()
            return False
        self._learn_from_last(episodes, n_steps)
        self.rollouts.end_block()
        return True

    def _learn_from_last(self, episodes: Episodes, n_steps: int) -> None:
        training, progress = self.training, self.progress[0]
        training.waits = self.rollouts.are_waited_for  # may have changed at the last step
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
            # Callbacks have been called already.
            self.has_begun = True
        elif wants_position(self.callback):
            self._write()
            self.rollouts.begin()
            self._read()
        else:
            self.rollouts.begin()

    def _steps_allowed(self, total_timesteps: int) -> Horizon:
        """The number of steps and episodes until a callback or the log is due."""
        agent = self.agent
        ahead, log = horizon(self.callback), self.training.until_log(self.log_interval)
        left = self.training.until_end(total_timesteps)
        over = self.training.until_rollout_end()
        steps = min(ahead.calls, log.calls, over.calls, left, self.block_steps, self.steps_at_once)
        self.progress[0]["episodes"] = getattr(agent, "_episode_num", 0)
        return Horizon(max(steps, 1), min(ahead.episodes, log.episodes, over.episodes))

    def _note_speed(self, n_steps: int, seconds: float) -> None:
        """Adapt the maximal length of a block; results do not depend on it."""
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
