"""What DQN and its kin share: training on compiled code."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ClassVar, Literal

import stable_baselines3
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule, TrainFrequencyUnit

from agents.networks.coverage import check_q_agent
from agents.networks.engine_costs import STEPS_OF_EPISODE, Work, work_of
from agents.networks.engine_setting import CompiledNetworks
from agents.networks.library_networks import Network, check_optimizer
from agents.networks.q_training import QTraining, q_network, q_training


class CompiledQLearning(CompiledNetworks, stable_baselines3.DQN):
    """`CompiledNetworks` says what the argument ``engine`` does.

    Attributes:
        target_kind: where the value of the next state is taken from: the lagging copy, the same
            for the action that the online network prefers, or the online network.
        largest_error: from where on the loss is no longer a square.
        collected: steps and episodes since the last training.
    """

    target_kind: ClassVar[Literal["target", "double_q", "online"]] = "target"
    largest_error: ClassVar[float] = 1.0

    _training: QTraining | None
    _shared_training: Callable[[], QTraining]
    _own = (*CompiledNetworks._own, "collected")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.collected = (0, 0)
        super().__init__(*args, **kwargs)

    @property
    def is_within_rollout(self) -> bool:
        return self.collected != (0, 0)

    def _check_compilable(self) -> None:
        check_q_agent(self)
        check_optimizer(self.policy.optimizer)
        q_network(self.q_net, self._seen_in_python())

    def _work_of(self, n_steps: float) -> Work:
        train_freq: Any = self.train_freq
        frequency = float(train_freq.frequency)
        if train_freq.unit == TrainFrequencyUnit.EPISODE:
            frequency *= STEPS_OF_EPISODE
        between = frequency * self.n_envs
        at_once = self.gradient_steps if self.gradient_steps >= 0 else between
        n_updates = max(n_steps - self.learning_starts, 0.0) / between * at_once
        seen = self.observation_space
        return work_of("q", [self.q_net], seen, n_steps, self.n_envs, n_updates, self.batch_size)

    def _schedules(self) -> list[Schedule]:
        return [*super()._schedules(), self.exploration_schedule]

    def _compiled_training(self, seen: Any) -> AbstractContextManager[QTraining]:
        return q_training(self, seen)

    def _acting_network(self, seen: Any) -> Network:
        return q_network(self.q_net, seen)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        if self._sharing is None:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        actions = self._shared_training().act(learning_starts)
        return actions, actions

    def _store_transition(self, replay_buffer: ReplayBuffer, *step: Any) -> None:
        super()._store_transition(replay_buffer, *step)
        if self._training is not None:
            self._training.check_numbers(replay_buffer.next_observations[replay_buffer.pos - 1])

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Take ``gradient_steps`` on batches of ``batch_size`` from the replay buffer."""
        if self._sharing is None:
            self._train_in_python(gradient_steps, batch_size)
        else:
            self._shared_training().train(gradient_steps)

    def _train_in_python(self, gradient_steps: int, batch_size: int) -> None:
        """The same in the library's way, or the agent's own."""
        super().train(gradient_steps, batch_size)
