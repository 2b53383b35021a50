"""Subclasses of the library's agents and of ours, each with one fault."""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.buffers import RolloutBuffer


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


class PPOEntropy(PPO):
    """Entropy is made small."""

    def train(self) -> None:
        """With the wrong sign."""
        weight, self.ent_coef = self.ent_coef, -self.ent_coef
        super().train()
        self.ent_coef = weight


class PPORatio(PPO):
    """Old by new, instead of new by old."""

    def train(self) -> None:
        """With the logarithms of all probabilities turned round."""
        evaluate = self.policy.evaluate_actions

        def turned_round(*args: Any) -> tuple[Any, th.Tensor, Any]:
            values, log_prob, entropy = evaluate(*args)
            return values, -log_prob, entropy

        self.policy.evaluate_actions = turned_round  # type: ignore[method-assign]
        self.rollout_buffer.log_probs *= -1
        super().train()
        del self.policy.evaluate_actions


class GAEWithoutLambda(RolloutBuffer):
    """Advantages that fade by gamma alone."""

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: Any) -> None:
        """As if lambda were 1 wherever it is not 0."""
        decay, self.gae_lambda = self.gae_lambda, float(self.gae_lambda > 0)
        super().compute_returns_and_advantage(last_values, dones)
        self.gae_lambda = decay


class PPOTraces(PPO):
    """Its advantages do not fade by lambda."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("rollout_buffer_class", GAEWithoutLambda)
        super().__init__(*args, **kwargs)


class ForgetfulDQN(DQN):
    """Its weights are not in the file."""

    def get_parameters(self) -> dict[str, Any]:
        """With zeros instead."""
        parameters = super().get_parameters()
        weights = parameters["policy"].items()
        return {**parameters, "policy": {name: th.zeros_like(part) for name, part in weights}}


class ForgetfulPPO(PPO):
    """Its learning rate's schedule is not in the file."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "learning_rate", "lr_schedule"]
