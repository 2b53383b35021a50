"""Deep agents written by hand on those of Stable-Baselines3."""

from __future__ import annotations

from functools import partial

import torch as th
from stable_baselines3 import DQN
from stable_baselines3.dqn.policies import QNetwork


def double_q_values(online: QNetwork, target: QNetwork, next_obs: th.Tensor) -> th.Tensor:
    """The target network's value of the action that the online network prefers.

    Args:
        online: the network that is trained.
        target: its lagging copy.
        next_obs: observations, shape (batch, ...).

    Returns:
        Values, shape (batch, 1).
    """
    best_actions = online(next_obs).argmax(dim=1, keepdim=True)
    values: th.Tensor = target(next_obs).gather(dim=1, index=best_actions)
    return values


class DoubleDQN(DQN):
    """Double DQN (van Hasselt, Guez and Silver, 2016): DQN but for its target.

    Arguments are those of `stable_baselines3.DQN`.
    """

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Take ``gradient_steps`` on batches of ``batch_size`` from the replay buffer."""
        target_network = self.q_net_target
        # DQN maximises over the columns of what this returns: there is one left to choose from.
        self.q_net_target = partial(double_q_values, self.q_net, target_network)  # type: ignore[assignment]
        try:
            super().train(gradient_steps, batch_size)
        finally:
            self.q_net_target = target_network
