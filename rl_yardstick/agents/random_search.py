"""Augmented random search, with the callbacks of every other agent."""

from __future__ import annotations

from typing import Any, Self

import sb3_contrib
from stable_baselines3.common.callbacks import BaseCallback
from torch.nn.utils import parameters_to_vector

from rl_yardstick.agents.common.callbacks import BlockCallback, members


class _TrainingStoppedError(Exception):
    """A callback stops the training, during a candidate's episodes."""

    def __init__(self, callback: BaseCallback) -> None:
        super().__init__()
        self.callback = callback


class ARS(sb3_contrib.ARS):
    """Augmented random search (Mania, Guy and Recht, 2018) of sb3-contrib.

    Arguments are those of `sb3_contrib.ARS`. The algorithm is the same. Callbacks get the results
    of each step, are called once per step, and can stop the training. A loaded agent continues from
    its weights, also without ``zero_policy``, and continues its schedules.
    """

    _last_dones: Any = None

    def _do_one_update(self, callback: BaseCallback, async_eval: Any) -> None:
        # Rollouts begin in the middle of an update, after its directions have been drawn.
        for member in members(callback):
            if isinstance(member, BlockCallback):
                member.at_safe_moment()
        super()._do_one_update(callback, async_eval)

    def learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Self:
        """As `sb3_contrib.ARS.learn`, but callbacks can stop the training."""
        try:
            return super().learn(total_timesteps, *args, **kwargs)
        except _TrainingStoppedError as stopped:
            stopped.callback.on_training_end()
            return self

    def _trigger_callback(
        self, _locals: dict[str, Any], _globals: dict[str, Any], callback: BaseCallback, n_envs: int
    ) -> None:
        """Called after a step for each environment whose episode counts; act on the first call."""
        if _locals["dones"] is self._last_dones:
            return
        self._last_dones = _locals["dones"]
        self.num_timesteps += n_envs
        callback.update_locals(_locals)
        if not callback.on_step():
            raise _TrainingStoppedError(callback)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # Use the total as changed by a callback or an earlier training.
        super()._update_current_progress_remaining(num_timesteps, self._total_timesteps)

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """As in the library; the search continues from the new parameters."""
        super().set_parameters(*args, **kwargs)
        self.weights = parameters_to_vector(self.policy.parameters()).detach()  # type: ignore[assignment]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_last_dones"]
