"""Deep agents written by hand on those of Stable-Baselines3."""

from __future__ import annotations

import inspect
import math
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.dqn.policies import QNetwork
from torch.nn.functional import mse_loss
from torch.nn.utils import clip_grad_norm_

from agents.common.signatures import full_signature
from agents.dqn import DQN, NextValues
from agents.networks.compiled_q_learning import CompiledQLearning
from agents.networks.engine_setting import NetworkEngineChoice


def double_q_values(online: NextValues, target: QNetwork, next_obs: th.Tensor) -> th.Tensor:
    """The target network's value of the action that the online network prefers.

    Args:
        online: the network that is trained, or what counts of its values.
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

    Arguments are those of `agents.dqn.DQN`; ``engine`` is ``"auto"`` by default.
    """

    __signature__: ClassVar[inspect.Signature]

    target_kind = "double_q"

    def __init__(self, *args: Any, engine: NetworkEngineChoice = "auto", **kwargs: Any) -> None:
        super().__init__(*args, engine=engine, **kwargs)

    def _next_values(self, target: QNetwork) -> NextValues:
        # One column, so that there is nothing left to choose from.
        online: NextValues = lambda next_obs: self._among_allowed(self.q_net(next_obs))  # noqa: E731
        return lambda next_obs: double_q_values(online, target, next_obs)


class DeepQLearning(CompiledQLearning):
    """Deep Q-learning with experience replay as first published (Mnih et al., 2013).

    DQN without what was added to it later: the target comes from the network that learns, as it is
    at that very update, and the loss is the squared error, where Stable-Baselines3's DQN has a
    lagging copy and Huber's loss. Arguments are those of `stable_baselines3.DQN` and ``engine`` of
    `agents.networks.engine_setting.CompiledNetworks`, which is ``"auto"`` by default;
    ``target_update_interval`` is without effect.
    """

    __signature__: ClassVar[inspect.Signature]

    target_kind = "online"
    largest_error = math.inf

    def __init__(self, *args: Any, engine: NetworkEngineChoice = "auto", **kwargs: Any) -> None:
        super().__init__(*args, engine=engine, **kwargs)

    def _train_in_python(self, gradient_steps: int, batch_size: int) -> None:
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = []
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            loss = self._loss(batch)
            self.policy.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
            losses.append(loss.item())
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(losses))

    def _loss(self, batch: ReplayBufferSamples) -> th.Tensor:
        """Half the mean squared error of the taken actions' values, a scalar."""
        discounts = self.gamma if batch.discounts is None else batch.discounts
        with th.no_grad():
            next_values = self.q_net(batch.next_observations).amax(dim=1, keepdim=True)
            targets = batch.rewards + (1 - batch.dones) * discounts * next_values
        values = self.q_net(batch.observations).gather(dim=1, index=batch.actions.long())
        return mse_loss(values, targets) / 2


for _algorithm in (DoubleDQN, DeepQLearning):
    _algorithm.__signature__ = full_signature(_algorithm)
