"""Evaluations during training: when they are due, and what is kept of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from agents.common.callback_horizons import Horizon, calls_until_multiple
from machine_code.work_time import WorkTime
from pipeline.evaluation.sampled import Evaluation, SampledEvaluator
from pipeline.evaluation.value_maps import ValueMapRecorder
from pipeline.files import replacing
from pipeline.finite_numbers import check_model
from pipeline.models.find import statistics_path
from pipeline.models.load import save_model, save_normalization
from pipeline.runs import Run
from pipeline.stopping import current

SECONDS_BETWEEN_WRITES = 1.0


class EvaluationCallback(EvalCallback):
    """`EvalCallback` with the evaluation handed to it, and files that are never half-written.

    It writes ``evaluations.npz`` and ``best_model.zip`` with its statistics of VecNormalize, and
    feeds the same callbacks and log entries as its parent.

    Args:
        run: where the files go.
        eval_env: the environment that the evaluation uses; its VecNormalize follows training's.
        evaluator: evaluates an agent.
        eval_freq: calls of `VecEnv.step` between two evaluations; 0 for none but those asked for
            by `evaluate_now`.
        eval_episode_freq: episodes between two evaluations, instead; 0 for none.
        callback_after_eval: told after every evaluation.
        value_maps: keeps the agent's policy at every evaluation, where that can be drawn.
        during: shows what goes on while an evaluation runs.

    Attributes:
        taken: the time that evaluations have taken.
        n_episodes: episodes of each evaluation, 0 of those that are exact.
        best_episodes: of the best one.
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
        during: Callable[[str], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        super().__init__(
            eval_env, callback_after_eval=callback_after_eval, eval_freq=eval_freq, verbose=0
        )
        self.run = run
        self.evaluator = evaluator
        self.eval_episode_freq = eval_episode_freq
        self.value_maps = value_maps
        self.during = during
        self.episodes_seen = 0
        self.last_evaluation: Evaluation | None = None
        self.best_timesteps = 0
        self.best_episodes = 0
        self.taken = WorkTime()
        self.n_episodes: list[int] = []
        self._is_written = True
        self._written_at = -np.inf

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
        return self.evaluate_now() if is_due and self._can_afford() else True

    def _can_afford(self) -> bool:
        sampled = self.evaluator if isinstance(self.evaluator, SampledEvaluator) else None
        return sampled is None or sampled.can_afford(self.model, self.episodes_seen)

    def _on_training_end(self) -> None:
        self.write()

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count what is done within among the time that evaluation takes."""
        begun = WorkTime.now()
        try:
            yield
        finally:
            self.taken += WorkTime.now() - begun

    def evaluate_now(self) -> bool:
        """Evaluate the agent as it is; False where a callback asks to stop the training.

        Raises:
            NotFiniteError: if the agent, or what it meets, is not finite.
        """
        check_model(self.model)
        self.take_statistics()
        with self.during("evaluating"), self.timed():
            evaluation = self.evaluator(self.model)
        self.last_evaluation = evaluation
        self.last_mean_reward = evaluation.mean_return
        self._append(evaluation)
        if self.value_maps is not None:
            self.value_maps.record(self.model, self.num_timesteps)
        self._log(evaluation)
        if evaluation.mean_return > self.best_mean_reward:
            self.best_mean_reward = evaluation.mean_return
            self.best_timesteps = self.num_timesteps
            self.best_episodes = self.n_episodes[-1]
            best = self.run.best_model_path
            with current().held():
                save_model(self.model, best)
                save_normalization(self.model, statistics_path(best))
        return self._on_event() if self.callback is not None else True

    def take_statistics(self) -> None:
        """Let evaluation normalise by the statistics that training has now."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)

    def _append(self, evaluation: Evaluation) -> None:
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(evaluation.returns.tolist())
        self.evaluations_length.append(evaluation.lengths.tolist())
        if evaluation.successes is not None:
            self.evaluations_successes.append(evaluation.successes.tolist())
        self.n_episodes.append(0 if evaluation.is_exact else len(evaluation.returns))
        self._is_written = False
        # To replace a file takes longer than an exact evaluation.
        if not 0 <= time.monotonic() - self._written_at < SECONDS_BETWEEN_WRITES:
            self.write()

    def write(self) -> None:
        """Write the evaluations, unless they are written already."""
        if self._is_written:
            return
        arrays: dict[str, Any] = {
            "timesteps": self.evaluations_timesteps,
            "results": _table(self.evaluations_results),
            "ep_lengths": _table(self.evaluations_length),
        }
        if self.evaluations_successes:
            arrays["successes"] = _table(self.evaluations_successes)
        if len(set(self.n_episodes)) > 1:
            arrays["n_episodes"] = self.n_episodes
        with replacing(self.run.evaluations_path) as file:
            np.savez(file, **arrays)
        self._is_written, self._written_at = True, time.monotonic()

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


def _table(rows: list[list[Any]]) -> NDArray[Any]:
    """Rows as one array; the shorter ones are repeated, which leaves mean and spread as they are.

    A single figure, as of an exact evaluation, stands twice: the plot commands of rl_zoo3 take rows
    of one for runs that are too short.
    """
    width = max(math.lcm(*map(len, rows)), 2)
    return np.array([row * (width // len(row)) for row in rows])
