"""Callbacks of a training: evaluations, checkpoints, pulls, and callbacks from settings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from rl_yardstick.agents.bandits.runs import PullLog
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from rl_yardstick.machine_code import WorkTime
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.critics import CriticRecorder
from rl_yardstick.pipeline.evaluation.sampled import Evaluation, SampledEvaluator
from rl_yardstick.pipeline.evaluation.value_maps import ValueMapRecorder
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.finite_numbers import (
    NotFiniteError,
    check_model,
    check_numbers,
    check_rows,
    is_finite,
)
from rl_yardstick.pipeline.models.find import checkpoint_file
from rl_yardstick.pipeline.models.load import save_model, save_normalization, save_replay_buffer
from rl_yardstick.pipeline.runs import LAST_PULLS, PULLS_FILE, Run
from rl_yardstick.pipeline.settings import components
from rl_yardstick.pipeline.stopping import current
from rl_yardstick.pipeline.train_spec import TrainSpec

# --- callbacks for settings: checkpoints, and exploration that decays per update ------------------


class Checkpoint(BlockCallback):
    """Base class of checkpoints: saves the agent as ``rl_model_<steps>_steps.zip``.

    It also saves VecNormalize statistics, under the file name of `CheckpointCallback`, and
    optionally the replay buffer.
    """

    def __init__(self, save_path: str | Path, with_replay_buffer: bool = False) -> None:
        super().__init__()
        self.save_path = Path(save_path)
        self.with_replay_buffer = with_replay_buffer

    def save(self) -> None:
        """Write the current agent."""
        path = self.save_path / f"rl_model_{self.num_timesteps}_steps.zip"
        with current().held():
            save_model(self.model, path)
            save_normalization(self.model, checkpoint_file(path, "vecnormalize"))
            if self.with_replay_buffer:
                save_replay_buffer(self.model, checkpoint_file(path, "replay_buffer"))


class StepCheckpoint(Checkpoint):
    """Saves a checkpoint every ``every_n_steps`` steps, counted over all environments."""

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
    """Saves a checkpoint every ``every_n_episodes`` episodes, counted over all environments.

    Args:
        every_n_episodes: episodes between two checkpoints, at least 1.
        save_path: the target folder; in a hyperparameter file, by default the run folder.
        with_replay_buffer: also write the agent's replay buffer, if it has one.
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
    """Multiplies DQN's epsilon by a constant factor at each gradient update.

    Args:
        initial_eps: epsilon before the first update; all arguments are in [0, 1].
        final_eps: the lower bound of epsilon.
        decay: the factor.
    """

    def __init__(
        self, initial_eps: float = 1.0, final_eps: float = 0.01, decay: float = 0.995
    ) -> None:
        super().__init__()
        self.initial_eps = initial_eps
        self.final_eps = final_eps
        self.decay = decay
        for name in ("initial_eps", "final_eps", "decay"):
            if not 0 <= (value := getattr(self, name)) <= 1:
                raise ValueError(f"{name} must lie between 0 and 1, not {value}")

    def check_model(self, model: BaseAlgorithm) -> None:
        """Raise ValueError for agents other than DQN and its subclasses."""
        if not isinstance(model, DQN):
            name = type(model).__name__
            raise ValueError(f"ExponentialExploration is for DQN and subclasses, not for {name}")

    def _on_rollout_start(self) -> None:
        updates = self.model._n_updates
        epsilon = max(self.final_eps, self.initial_eps * self.decay**updates)
        # The algorithm reads its schedule after each step: it must equal the current rate.
        model: Any = self.model
        model.exploration_schedule = ConstantSchedule(epsilon)
        model.exploration_rate = epsilon

    def _on_step(self) -> bool:
        return True


# --- non-finite numbers end a training ------------------------------------------------------------

# The log entries with losses of the library's agents. Other entries may be nan, for example the
# explained variance of constant returns.
LOSSES = (
    "train/loss",
    "train/actor_loss",
    "train/critic_loss",
    "train/ent_coef_loss",
    "train/value_loss",
)

_NO_EPISODE: Mapping[str, float] = {"r": 0.0}


class NumberWatch(BlockCallback):
    """Checks the numbers of each step (or of a compiled block's last step) and the losses."""

    takes_blocks = True

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Store the training loop's variables without a copy, because this runs at each step."""
        self.locals = locals_

    def _on_training_start(self) -> None:
        when = f"at step {self.model.num_timesteps:,}"
        if self.model._last_obs is not None:
            check_rows(self.model._last_obs, "observation", when)

    def _on_rollout_start(self) -> None:
        log = self.model.logger.name_to_value
        for name in LOSSES:
            if name in log and not isfinite(log[name]):
                raise NotFiniteError(f"{name} at step {self.model.num_timesteps:,}", log[name])

    def _on_step(self) -> bool:
        seen = self.locals
        # Algorithms that play whole episodes, such as ARS, pass other variables.
        new_obs = seen.get("new_obs", seen.get("new_observations"))
        rewards, actions = seen.get("rewards"), seen.get("actions")
        if not (is_finite(rewards) and is_finite(new_obs) and is_finite(actions)):
            when = f"at step {self.num_timesteps:,}"
            check_rows(rewards, "reward", when)
            check_rows(new_obs, "observation", when)
            check_rows(actions, "action", when)
        dones = seen.get("dones")
        if dones is None or True not in (ended := dones.tolist()):
            return True
        # Observations before resets, and the returns in Monitor's records.
        for i, info in enumerate(seen["infos"]):
            if not ended[i]:
                continue
            last, total = info.get("terminal_observation"), info.get("episode", _NO_EPISODE)["r"]
            if not (is_finite(last) and isfinite(total)):
                where = f"of an episode of environment {i} at step {self.num_timesteps:,}"
                check_numbers(last, "last observation", where)
                check_numbers(total, "return", where)
        return True


# --- the pulls of a training on a bandit ----------------------------------------------------------


@dataclass(frozen=True)
class PullSummary:
    """Summary of the pulls of a training."""

    n_pulls: int  # over all environments
    n_matched: int  # pulls with a reward in the log; all pulls without a log
    reward: float | None  # mean of the matched pulls; None if no pull matched
    # sum over pulls of the best expected reward minus that of the pulled arm; None if expected
    # rewards are unknown, as with a log
    regret: float | None
    optimal: float | None  # share of best arms among the last pulls; None as for ``regret``


def summarise_pulls(pulls: Mapping[str, NDArray[Any]]) -> PullSummary:
    """Compute the summary from the arrays of `PullLog.arrays`."""
    regrets, matched = pulls["regrets"], pulls["matched"]
    is_known = not bool(np.isnan(regrets).any())
    return PullSummary(
        n_pulls=int(regrets.size),
        n_matched=int(matched.sum()),
        reward=float(pulls["rewards"][matched].mean(dtype=np.float64)) if matched.any() else None,
        regret=float(regrets.sum()) if is_known else None,
        optimal=float(pulls["optimal"][:, -LAST_PULLS:].mean()) if is_known else None,
    )


class PullRecorder(PullLog):
    """Writes ``pulls.npz`` at the end of training, with the contents of `PullLog.arrays`."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_training_end(self) -> None:
        self.write()

    def write(self) -> None:
        """Write the pulls up to now."""
        with replacing(self.folder / PULLS_FILE) as file:
            np.savez(file, allow_pickle=False, **self.arrays())


# --- evaluations during training: when they are due, and what they store --------------------------

SECONDS_BETWEEN_WRITES = 1.0


class EvaluationCallback(EvalCallback):
    """An `EvalCallback` with a given evaluation function and atomically written files.

    It writes ``evaluations.npz`` and ``best_model.zip`` with its VecNormalize statistics. It
    triggers the same callbacks and log entries as its base class.
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
        critics: CriticRecorder | None = None,
        during: Callable[[str], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        # Calls of `VecEnv.step` between two evaluations, or episodes; 0 for none.
        super().__init__(
            eval_env, callback_after_eval=callback_after_eval, eval_freq=eval_freq, verbose=0
        )
        self.eval_episode_freq = eval_episode_freq
        self.run = run
        self.evaluator = evaluator
        self.value_maps = value_maps
        self.critics = critics  # with ``--diagnose``
        self.during = during  # shows the activity during evaluations
        self.episodes_seen = 0
        self.last_evaluation: Evaluation | None = None
        self.best_timesteps = 0
        self.best_episodes = 0
        self.taken = WorkTime()  # the total time of evaluations
        self.n_episodes: list[int] = []  # of each evaluation; 0 if it is exact
        self._is_written = True
        self._written_at = -np.inf

    def horizon(self) -> Horizon:
        """When the next evaluation is due."""
        return Horizon(
            calls_until_multiple(self.n_calls, self.eval_freq),
            calls_until_multiple(self.episodes_seen, self.eval_episode_freq),
        )

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        """Count skipped calls."""
        self.n_calls += n_calls
        self.episodes_seen += n_episodes

    @property
    def is_asked_for(self) -> bool:
        """Whether evaluations during training are requested."""
        return self.eval_freq > 0 or self.eval_episode_freq > 0

    def _init_callback(self) -> None:
        """Skip the library's check that training and evaluation environments have one type."""

    def _on_step(self) -> bool:
        before = self.episodes_seen
        self.episodes_seen += int(np.sum(self.locals["dones"]))
        is_due = self.eval_freq > 0 and self.n_calls % self.eval_freq == 0
        if every := max(self.eval_episode_freq, 0):
            is_due |= self.episodes_seen // every > before // every
        if is_due and isinstance(self.evaluator, SampledEvaluator):
            is_due = self.evaluator.can_afford(self.model, self.episodes_seen)
        return self.evaluate_now() if is_due else True

    def _on_training_end(self) -> None:
        self.write()

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Add the duration of the ``with`` statement to the time of evaluations."""
        begun = WorkTime.now()
        try:
            yield
        finally:
            self.taken += WorkTime.now() - begun

    def evaluate_now(self) -> bool:
        """Evaluate the current agent; False if a callback asks to stop the training."""
        check_model(self.model)
        self.take_statistics()
        with self.during("evaluating"), self.timed():
            evaluation = self.evaluator(self.model)
        self.last_evaluation = evaluation
        self.last_mean_reward = evaluation.mean_return
        self._append(evaluation)
        if self.value_maps is not None:
            self.value_maps.record(self.model, self.num_timesteps)
        if self.critics is not None:
            self.critics.judge(self.num_timesteps, self.episodes_seen)
        self._log(evaluation)
        if evaluation.mean_return > self.best_mean_reward:
            self.best_mean_reward = evaluation.mean_return
            self.best_timesteps = self.num_timesteps
            self.best_episodes = self.n_episodes[-1]
            best = self.run.best_model_path
            with current().held():
                save_model(self.model, best)
                save_normalization(self.model, checkpoint_file(best, "vecnormalize"))
        return self._on_event() if self.callback is not None else True

    def take_statistics(self) -> None:
        """Copy training's current normalisation statistics to evaluation."""
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
        # Replacing a file takes longer than an exact evaluation.
        if not 0 <= time.monotonic() - self._written_at < SECONDS_BETWEEN_WRITES:
            self.write()

    def write(self) -> None:
        """Write the evaluations that are not written yet."""
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
    """Rows as one array, shorter rows repeated; rl_zoo3's plots need at least two columns."""
    width = max(math.lcm(*map(len, rows)), 2)
    return np.array([row * (width // len(row)) for row in rows])


# --- the callbacks of a training ------------------------------------------------------------------

EVALUATIONS_PER_RUN = 20


def named_callbacks(spec: TrainSpec, run: Run, model: BaseAlgorithm) -> list[BaseCallback]:
    """The callbacks from the hyperparameters, and the requested checkpoints."""
    callbacks: list[BaseCallback] = components.callbacks(
        spec.hyperparams.callback, spec.gym_packages, run.path
    )
    for callback in callbacks:
        if isinstance(callback, ExponentialExploration):
            callback.check_model(model)
    if spec.hyperparams.n_episodes is not None and isinstance(model, OnPolicyAlgorithm):
        schedules = [getattr(model, name, None) for name in ("lr_schedule", "clip_range")]
        if any(callable(s) and s(1.0) != s(0.0) for s in schedules):
            raise UserError(
                f"the schedules of {spec.algo} run by steps: give n_timesteps instead of "
                "n_episodes, or constant values"
            )
    if spec.save_freq > 0:
        callbacks.append(StepCheckpoint(spec.save_freq, run.path, spec.save_replay_buffer))
    if spec.save_every_n_episodes > 0:
        every = spec.save_every_n_episodes
        callbacks.append(EpisodeCheckpoint(every, run.path, spec.save_replay_buffer))
    return callbacks


def evaluation_intervals(
    spec: TrainSpec, n_envs: int, is_judged_by_regret: bool
) -> tuple[int, int]:
    """Calls of `VecEnv.step`, and episodes, between two evaluations; 0 for none."""
    if spec.eval_freq is not None:
        return (max(spec.eval_freq // n_envs, 1), 0) if spec.eval_freq > 0 else (0, 0)
    if is_judged_by_regret:
        # Evaluation episodes may have other arms, so training pulls are more informative.
        return 0, 0
    if spec.hyperparams.n_timesteps is not None:
        return max(spec.hyperparams.n_timesteps // EVALUATIONS_PER_RUN // n_envs, 1), 0
    return 0, -(-(spec.hyperparams.n_episodes or 1) // EVALUATIONS_PER_RUN)
