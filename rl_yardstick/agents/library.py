"""Agents of Stable-Baselines3 with compiled engines and masks, and deep agents built on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import stable_baselines3
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.dqn.policies import QNetwork
from torch.nn.functional import mse_loss
from torch.nn.utils import clip_grad_norm_

from rl_yardstick.agents.common.masks import check_masks_exist, checked_masks, present_masks
from rl_yardstick.agents.networks.dqn import CompiledQLearning
from rl_yardstick.agents.networks.engine_setting import NetworkEngineChoice
from rl_yardstick.agents.networks.policy_gradients import CompiledPolicyGradient
from rl_yardstick.envs.wrappers import INFO_KEY
from rl_yardstick.mdp.transition_model import Bools

# From observations of shape (batch, ...) to the action values in targets.
NextValues = Callable[[th.Tensor], th.Tensor]


class MaskedReplayBuffer(ReplayBuffer):
    """Stores with each transition the action mask of its next state.

    The masks are in the same array as the actions, so that both are sampled together.
    """

    action_space: spaces.Discrete
    sampled_masks: th.Tensor  # of the last sampled batch, bool of shape (batch, n_actions)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.action_dim = 1 + int(self.action_space.n)
        shape = (self.buffer_size, self.n_envs, self.action_dim)
        self.actions = np.zeros(shape, dtype=self.actions.dtype)

    def __getstate__(self) -> dict[str, Any]:
        # The masks of a batch are only valid for that batch.
        return {name: value for name, value in vars(self).items() if name != "sampled_masks"}

    def add(
        self,
        obs: NDArray[Any],
        next_obs: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Store a step of every environment, with the masks in ``infos``."""
        everything = np.ones(self.action_dim - 1, dtype=np.bool_)
        masks = [
            # After a termination the mask is not used.
            everything if ended and not info.get("TimeLimit.truncated", False) else info[INFO_KEY]
            for ended, info in zip(done, infos, strict=True)
        ]
        checked = checked_masks(masks, next_obs, self.action_dim - 1)
        with_masks = np.column_stack([action.reshape(self.n_envs), checked])
        super().add(obs, next_obs, with_masks, reward, done, infos)

    def _get_samples(
        self, batch_inds: NDArray[Any], env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        samples = super()._get_samples(batch_inds, env)
        self.sampled_masks = samples.actions[:, 1:].bool()
        return samples._replace(actions=samples.actions[:, :1])


class DQN(CompiledQLearning):
    """Stable-Baselines3's DQN, with optional action masks (``mask_actions``).

    Masks apply to exploration, to the greedy choice, and to the maximum of the target, for which
    the replay buffer stores them. Without masks, the agent and its model files are the same as the
    library's. Arguments are those of `stable_baselines3.DQN` and:

    Args:
        mask_actions: whether to use masks. The environment must provide them by ``action_masks()``
            and by ``info["action_mask"]``: `envs.wrappers.ActionMasks` does both.

    Raises:
        ValueError: if it does not, or with ``n_steps`` above 1, Dict observations, or another
            replay buffer.
    """

    def __init__(self, *args: Any, mask_actions: bool = False, **kwargs: Any) -> None:
        self.mask_actions = mask_actions
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        if self.mask_actions:
            if self.n_steps != 1:
                raise ValueError(f"mask_actions needs n_steps of 1, not {self.n_steps}")
            if isinstance(self.observation_space, spaces.Dict):
                raise ValueError("mask_actions does not work with Dict observations")
            if self.replay_buffer_class not in {None, ReplayBuffer, MaskedReplayBuffer}:
                raise ValueError("mask_actions needs its own replay buffer, no replay_buffer_class")
            if self.env is not None:
                check_masks_exist(self.env)
            self.replay_buffer_class = MaskedReplayBuffer
        super()._setup_model()

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        prepared = super()._setup_learn(*args, **kwargs)
        if self.mask_actions:
            assert self.env is not None
            check_masks_exist(self.env)
            if not all(INFO_KEY in (info or {}) for info in self.env.unwrapped.reset_infos):
                raise ValueError(
                    f"mask_actions of {type(self).__name__}: info holds no {INFO_KEY}, which tells "
                    "of states that episodes are cut off in: wrap the environment in "
                    "rl_yardstick.envs.wrappers.ActionMasks"
                )
        return prepared

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        if not self.mask_actions:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        assert self.env is not None
        obs: Any = self._last_obs
        masks = present_masks(self.env, obs)
        if self.num_timesteps < learning_starts:
            actions = self._random_actions(masks)
        else:
            actions, _ = self.predict(obs, action_masks=masks)
        return actions, actions

    def _random_actions(self, masks: Bools) -> NDArray[Any]:
        """A uniformly random allowed action for each row of ``masks``."""
        space: Any = self.action_space
        return np.array([space.sample(mask.astype(np.int8)) for mask in masks])

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The greedy action, or an exploring one unless ``deterministic``, as in the library.

        Args:
            observation: one, or several along the first axis.
            state: returned unchanged.
            episode_start: not used.
            deterministic: take the greedy action.
            action_masks: the allowed actions, bool of shape (n, n_actions), or (n_actions,) for one
                observation; default: all actions.
        """
        if action_masks is None:
            return super().predict(observation, state, episode_start, deterministic)
        masks = np.atleast_2d(np.asarray(action_masks, dtype=np.bool_))
        self.policy.set_training_mode(False)
        obs, is_batch = self.policy.obs_to_tensor(observation)
        # One random number for all observations, as in the library.
        if not deterministic and np.random.rand() < self.exploration_rate:  # noqa: NPY002
            actions = self._random_actions(masks)
        else:
            with th.no_grad():
                values = masked(self.q_net(obs), th.as_tensor(masks, device=self.device))
            actions = values.argmax(dim=1).cpu().numpy()
        return (actions if is_batch else actions[0]), state

    def _train_in_python(self, gradient_steps: int, batch_size: int) -> None:
        target_network = self.q_net_target
        # The library takes the maximum over the columns of this function's result.
        self.q_net_target = self._next_values(target_network)  # type: ignore[assignment]
        try:
            super()._train_in_python(gradient_steps, batch_size)
        finally:
            self.q_net_target = target_network

    def _next_values(self, target: QNetwork) -> NextValues:
        """The values in a target's maximum: the target network's values of allowed actions."""
        return lambda next_obs: self._among_allowed(target(next_obs))

    def _among_allowed(self, next_values: th.Tensor) -> th.Tensor:
        """Replace the values of actions that a batch's next states forbid by minus infinity."""
        if not self.mask_actions:
            return next_values
        assert isinstance(self.replay_buffer, MaskedReplayBuffer)
        return masked(next_values, self.replay_buffer.sampled_masks)

    def _excluded_save_params(self) -> list[str]:
        # Without masks the file is the library's; with them, they determine the buffer's class.
        left_out = "replay_buffer_class" if self.mask_actions else "mask_actions"
        return [*super()._excluded_save_params(), left_out]


def masked(values: th.Tensor, masks: th.Tensor) -> th.Tensor:
    """The values, with minus infinity where the mask is False; both of shape (n, n_actions)."""
    return values.masked_fill(~masks, -th.inf)


def double_q_values(online: NextValues, target: QNetwork, next_obs: th.Tensor) -> th.Tensor:
    """The target network's value of the action that the online network prefers."""
    best_actions = online(next_obs).argmax(dim=1, keepdim=True)
    values: th.Tensor = target(next_obs).gather(dim=1, index=best_actions)
    return values


class DoubleDQN(DQN):
    """Double DQN (van Hasselt, Guez and Silver, 2016): DQN with another target.

    Arguments are those of `agents.library.DQN`; ``engine`` is ``"auto"`` by default.
    """

    target_kind = "double_q"

    def __init__(self, *args: Any, engine: NetworkEngineChoice = "auto", **kwargs: Any) -> None:
        super().__init__(*args, engine=engine, **kwargs)

    def _next_values(self, target: QNetwork) -> NextValues:
        # One column, so that the library's maximum has no effect.
        online: NextValues = lambda next_obs: self._among_allowed(self.q_net(next_obs))  # noqa: E731
        return lambda next_obs: double_q_values(online, target, next_obs)


class DeepQLearning(CompiledQLearning):
    """Deep Q-learning with experience replay as first published (Mnih et al., 2013).

    DQN without later additions: the target comes from the online network at the same update, and
    the loss is the squared error, while Stable-Baselines3's DQN has a target network and Huber's
    loss. Arguments are those of `stable_baselines3.DQN` and ``engine`` of
    `agents.networks.engine_setting.CompiledNetworks`, which is ``"auto"`` by default;
    ``target_update_interval`` has no effect.
    """

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


class PPO(CompiledPolicyGradient, stable_baselines3.PPO):
    """Stable-Baselines3's PPO (Schulman et al., 2017), with the argument ``engine``."""


class A2C(CompiledPolicyGradient, stable_baselines3.A2C):
    """Stable-Baselines3's A2C (Mnih et al., 2016), with the argument ``engine``."""
