"""Callbacks beside evaluation: checkpoints, and exploration that decays by the update.

A hyperparameter file may name `EpisodeCheckpoint` and `ExponentialExploration` under ``callback``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import ConstantSchedule

from agents.common.callback_horizons import BlockCallback, Horizon
from pipeline.models.find import replay_buffer_path, statistics_path
from pipeline.models.load import save_model, save_normalization, save_replay_buffer
from pipeline.stopping import current


class Checkpoint(BlockCallback):
    """Keeps the agent as it is at some moments, as ``rl_model_<steps>_steps.zip``.

    Statistics of VecNormalize go with it, under the name that `CheckpointCallback` gives them.

    Args:
        save_path: folder to write to.
        with_replay_buffer: write the agent's replay buffer each time too, where it has one.
    """

    def __init__(self, save_path: str | Path, with_replay_buffer: bool = False) -> None:
        super().__init__()
        self.save_path = Path(save_path)
        self.with_replay_buffer = with_replay_buffer

    def save(self) -> None:
        """Write the agent as it is now."""
        path = self.save_path / f"rl_model_{self.num_timesteps}_steps.zip"
        with current().held():
            save_model(self.model, path)
            save_normalization(self.model, statistics_path(path))
            if self.with_replay_buffer:
                save_replay_buffer(self.model, replay_buffer_path(path))


class StepCheckpoint(Checkpoint):
    """A checkpoint every ``every_n_steps`` environment steps, counted over all environments.

    Raises:
        ValueError: if the number is below 1.
    """

    def __init__(
        self, every_n_steps: int, save_path: str | Path, with_replay_buffer: bool = False
    ) -> None:
        super().__init__(save_path, with_replay_buffer)
        if every_n_steps < 1:
            raise ValueError(f"every_n_steps must be at least 1, not {every_n_steps}")
        self.every_n_steps = every_n_steps

    def _on_step(self) -> bool:
        self.save()
        return True


class EpisodeCheckpoint(Checkpoint):
    """A checkpoint every ``every_n_episodes`` episodes, counted over all environments.

    Args:
        every_n_episodes: episodes between two checkpoints.
        save_path: folder to write to; in a hyperparameter file, the run's unless given.
        with_replay_buffer: write the agent's replay buffer each time too, where it has one.

    Raises:
        ValueError: if the number is below 1.
    """

    def __init__(
        self, every_n_episodes: int, save_path: str | Path, with_replay_buffer: bool = False
    ) -> None:
        super().__init__(save_path, with_replay_buffer)
        if every_n_episodes < 1:
            raise ValueError(f"every_n_episodes must be at least 1, not {every_n_episodes}")
        self.every_n_episodes = every_n_episodes
        self.episodes_seen = 0

    def horizon(self) -> Horizon:
        return Horizon(episodes=self.every_n_episodes - self.episodes_seen % self.every_n_episodes)

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        super().pass_over(n_calls, n_episodes)
        self.episodes_seen += n_episodes

    def _on_step(self) -> bool:
        before = self.episodes_seen
        self.episodes_seen += int(np.sum(self.locals["dones"]))
        if self.episodes_seen // self.every_n_episodes > before // self.every_n_episodes:
            self.save()
        return True


class ExponentialExploration(BaseCallback):
    """Let epsilon of DQN fall by a constant factor at each gradient update.

    Args:
        initial_eps: epsilon before the first update.
        final_eps: the value that it does not fall below.
        decay: the factor.

    Raises:
        ValueError: if a value lies outside [0, 1].
    """

    def __init__(
        self, initial_eps: float = 1.0, final_eps: float = 0.01, decay: float = 0.995
    ) -> None:
        super().__init__()
        for name, value in (
            ("initial_eps", initial_eps),
            ("final_eps", final_eps),
            ("decay", decay),
        ):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must lie between 0 and 1, not {value}")
        self.initial_eps = initial_eps
        self.final_eps = final_eps
        self.decay = decay

    def check_model(self, model: BaseAlgorithm) -> None:
        """Refuse agents whose exploration this callback cannot change.

        Raises:
            ValueError: if the agent is not a DQN.
        """
        if not isinstance(model, DQN):
            name = type(model).__name__
            raise ValueError(f"ExponentialExploration is for DQN and its kin, not for {name}")

    def _on_rollout_start(self) -> None:
        updates = self.model._n_updates
        epsilon = max(self.final_eps, self.initial_eps * self.decay**updates)
        # The algorithm reads its schedule after each step: it must agree with the present rate.
        model: Any = self.model
        model.exploration_schedule = ConstantSchedule(epsilon)
        model.exploration_rate = epsilon

    def _on_step(self) -> bool:
        return True
