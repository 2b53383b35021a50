"""Subclasses of the library's agents and of ours, each with the fault that ``FAULTS`` names."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.utils import explained_variance
from torch.nn.functional import mse_loss

from agents.tabular.one_step import QLearning


class DQNSharesMemory(DQN):
    """Has one memory for all agents of the class, as a mutable default would make it."""

    memories: ClassVar[dict[str, Any]] = {}

    def _setup_model(self) -> None:
        key = f"{self.observation_space} {self.action_space} {self.buffer_size}"
        self.replay_buffer = self.memories.get(key)
        super()._setup_model()
        self.memories[key] = self.replay_buffer


class DQNNeverCopies(DQN):
    """Its target network stays as it began."""

    def _on_step(self) -> None:
        tau, self.tau = self.tau, 0.0
        super()._on_step()
        self.tau = tau


class DQNAlwaysCopies(DQN):
    """Its target network follows at each training."""

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """After copying."""
        self.q_net_target.load_state_dict(self.q_net.state_dict())
        super().train(gradient_steps, batch_size)


class DQNWithoutOptimizer(DQN):
    """Saves its weights alone."""

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["q_net", "q_net_target"], []


class WrittenOutPPO(PPO):
    """The library's PPO with its loss written out, which the faults change."""

    advantage_sign, entropy_sign, ratio_sign = 1, 1, 1

    def train(self) -> None:
        """Some epochs on the rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                actions = batch.actions.long().flatten()
                values, log_prob, entropy = self.policy.evaluate_actions(
                    batch.observations, actions
                )
                advantages = batch.advantages
                if len(advantages) > 1:
                    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
                advantages = advantages * self.advantage_sign
                ratio = th.exp(self.ratio_sign * (log_prob - batch.old_log_prob))
                clipped = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
                policy_loss = -th.min(advantages * ratio, advantages * clipped).mean()
                value_loss = mse_loss(batch.returns, values.flatten())
                assert entropy is not None
                entropy_loss = -self.entropy_sign * entropy.mean()
                loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
        self._n_updates += self.n_epochs
        buffer = self.rollout_buffer
        self.logger.record(
            "train/explained_variance",
            explained_variance(buffer.values.flatten(), buffer.returns.flatten()),
        )


class PPOEntropy(WrittenOutPPO):
    """Entropy is made small."""

    entropy_sign = -1


class PPORatio(WrittenOutPPO):
    """Old by new, instead of new by old."""

    ratio_sign = -1


class GAEWithoutLambda(RolloutBuffer):
    """Advantages that fade by gamma alone."""

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: Any) -> None:
        """The library's loop, without lambda."""
        last, next_values = 0.0, last_values.clone().cpu().numpy().flatten()
        for step in reversed(range(self.buffer_size)):
            if step == self.buffer_size - 1:
                goes_on = 1.0 - dones.astype(np.float32)
            else:
                goes_on = 1.0 - self.episode_starts[step + 1]
                next_values = self.values[step + 1]
            error = self.rewards[step] + self.gamma * next_values * goes_on - self.values[step]
            last = error + self.gamma * goes_on * last * (self.gae_lambda > 0)
            self.advantages[step] = last
        self.returns = self.advantages + self.values


class PPOTraces(PPO):
    """Its advantages do not fade by lambda."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("rollout_buffer_class", GAEWithoutLambda)
        super().__init__(*args, **kwargs)


class ForgetfulQLearning(QLearning):
    """Its table is not in the file."""

    def get_parameters(self) -> dict[str, Any]:
        """With an empty table."""
        parameters = super().get_parameters()
        table = parameters["policy"]["q_tables"]
        return {**parameters, "policy": {**parameters["policy"], "q_tables": th.zeros_like(table)}}


class ForgetfulPPO(PPO):
    """Its learning rate's schedule is not in the file."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "learning_rate", "lr_schedule"]


FAULTS = {
    "DQNNeverCopies": "target-never-copied",
    "DQNAlwaysCopies": "target-always-copied",
    "ForgetfulQLearning": "zip-forgets-tables",
    "DQNSharesMemory": "shared-buffer",
    "DQNWithoutOptimizer": "zip-forgets-optimizer",
    "PPOEntropy": "entropy-sign",
    "PPORatio": "importance-ratio",
    "PPOTraces": "traces",
    "ForgetfulPPO": "zip-forgets-schedules",
}
