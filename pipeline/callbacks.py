"""Callbacks: evaluation, checkpoints, and exploration that decays by the update.

Those that a hyperparameter file may name under ``callback`` are `EpisodeCheckpoint` and
`ExponentialExploration`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from agents.common.callback_horizons import BlockCallback, Horizon, calls_until_multiple
from pipeline.evaluation.sampled import Evaluation
from pipeline.evaluation.value_maps import ValueMapRecorder
from pipeline.files import replacing
from pipeline.run_folder import Run


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Write the agent to ``path``, whole or not at all."""
    with replacing(path) as draft:
        model.save(draft)


def save_normalization(model: BaseAlgorithm, run: Run) -> None:
    """Write the running statistics of VecNormalize, where the agent trains under one."""
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        with replacing(run.vecnormalize_path) as draft:
            normalization.save(str(draft))


class EvaluationCallback(EvalCallback):
    """`EvalCallback` with the evaluation handed to it, and files that are never half-written.

    It writes ``evaluations.npz`` and ``best_model.zip`` and feeds the same callbacks and log
    entries as its parent.

    Args:
        run: where the files go.
        eval_env: the environment that the evaluation uses; its VecNormalize follows training's.
        evaluator: evaluates an agent.
        eval_freq: calls of `VecEnv.step` between two evaluations; 0 for none but those asked for
            by `evaluate_now`.
        eval_episode_freq: episodes between two evaluations, instead; 0 for none.
        callback_after_eval: told after every evaluation.
        value_maps: keeps the agent's policy at every evaluation, where that can be drawn.
    """

    def __init__(
        self,
        run: Run,
        eval_env: VecEnv,
        evaluator: Callable[[BaseAlgorithm], Evaluation],
        eval_freq: int,
        eval_episode_freq: int = 0,
        callback_after_eval: BaseCallback | None = None,
        value_maps: ValueMapRecorder | None = None,
    ) -> None:
        super().__init__(
            eval_env, callback_after_eval=callback_after_eval, eval_freq=eval_freq, verbose=0
        )
        self.run = run
        self.evaluator = evaluator
        self.eval_episode_freq = eval_episode_freq
        self.value_maps = value_maps
        self.episodes_seen = 0
        self.last_evaluation: Evaluation | None = None
        self.best_timesteps = 0

    def horizon(self) -> Horizon:
        """When the next evaluation is due."""
        return Horizon(
            calls_until_multiple(self.n_calls, self.eval_freq),
            calls_until_multiple(self.episodes_seen, self.eval_episode_freq),
        )

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        """Take note of calls that were left out."""
        self.n_calls += n_calls
        self.episodes_seen += n_episodes

    @property
    def is_asked_for(self) -> bool:
        """Whether there are to be evaluations during training."""
        return self.eval_freq > 0 or self.eval_episode_freq > 0

    def _init_callback(self) -> None:
        """Training and evaluation environments may be of different kinds here."""

    def _on_step(self) -> bool:
        before = self.episodes_seen
        self.episodes_seen += int(np.sum(self.locals["dones"]))
        is_due = self.eval_freq > 0 and self.n_calls % self.eval_freq == 0
        if self.eval_episode_freq > 0:
            is_due |= (
                self.episodes_seen // self.eval_episode_freq > before // self.eval_episode_freq
            )
        return self.evaluate_now() if is_due else True

    def evaluate_now(self) -> bool:
        """Evaluate the agent as it is; False where a callback asks to stop the training."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        evaluation = self.evaluator(self.model)
        self.last_evaluation = evaluation
        self.last_mean_reward = evaluation.mean_return
        self._append_to_file(evaluation)
        if self.value_maps is not None:
            self.value_maps.record(self.model, self.num_timesteps)
        self._log(evaluation)
        if evaluation.mean_return > self.best_mean_reward:
            self.best_mean_reward = evaluation.mean_return
            self.best_timesteps = self.num_timesteps
            save_model(self.model, self.run.best_model_path)
            save_normalization(self.model, self.run)
        return self._on_event() if self.callback is not None else True

    def _append_to_file(self, evaluation: Evaluation) -> None:
        self.evaluations_timesteps.append(self.num_timesteps)
        # A single figure, as of an exact evaluation, stands twice: the plot commands of rl_zoo3
        # take rows of one for runs that are too short.
        times = 2 if len(evaluation.returns) == 1 else 1
        self.evaluations_results.append(evaluation.returns.tolist() * times)
        self.evaluations_length.append(evaluation.lengths.tolist() * times)
        arrays: dict[str, Any] = {
            "timesteps": self.evaluations_timesteps,
            "results": self.evaluations_results,
            "ep_lengths": self.evaluations_length,
        }
        if evaluation.successes is not None:
            self.evaluations_successes.append(evaluation.successes.tolist() * times)
            arrays["successes"] = self.evaluations_successes
        with replacing(self.run.evaluations_path) as draft, draft.open("wb") as file:
            np.savez(file, **arrays)

    def _log(self, evaluation: Evaluation) -> None:
        self.logger.record("eval/mean_reward", evaluation.mean_return)
        self.logger.record("eval/mean_ep_length", float(evaluation.lengths.mean()))
        if evaluation.success_rate is not None:
            self.logger.record("eval/success_rate", evaluation.success_rate)
        if evaluation.yardstick is not None:
            self.logger.record("eval/gap", evaluation.yardstick.gap(evaluation.mean_return))
            self.logger.record("eval/score", evaluation.yardstick.score(evaluation.mean_return))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)


class Checkpoint(BlockCallback):
    """Keeps the agent as it is at some moments, as ``rl_model_<steps>_steps.zip``.

    Args:
        save_path: folder to write to.
    """

    def __init__(self, save_path: str | Path) -> None:
        super().__init__()
        self.save_path = Path(save_path)

    def save(self) -> None:
        """Write the agent as it is now."""
        save_model(self.model, self.save_path / f"rl_model_{self.num_timesteps}_steps.zip")


class StepCheckpoint(Checkpoint):
    """A checkpoint every ``every_n_steps`` environment steps, counted over all environments.

    Raises:
        ValueError: if the number is below 1.
    """

    def __init__(self, every_n_steps: int, save_path: str | Path) -> None:
        super().__init__(save_path)
        if every_n_steps < 1:
            raise ValueError(f"every_n_steps must be at least 1, not {every_n_steps}")
        self.every_n_steps = every_n_steps

    def horizon(self) -> Horizon:
        steps = self.every_n_steps - self.num_timesteps % self.every_n_steps
        return Horizon(calls=-(-steps // self.training_env.num_envs))

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every_n_steps < self.training_env.num_envs:
            self.save()
        return True


class EpisodeCheckpoint(Checkpoint):
    """A checkpoint every ``every_n_episodes`` episodes, counted over all environments.

    Args:
        every_n_episodes: episodes between two checkpoints.
        save_path: folder to write to; in a hyperparameter file, the run's unless given.

    Raises:
        ValueError: if the number is below 1.
    """

    def __init__(self, every_n_episodes: int, save_path: str | Path) -> None:
        super().__init__(save_path)
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
        """Refuse agents whose exploration is no business of this callback.

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
