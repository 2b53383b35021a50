"""Callbacks of a training: evaluations, checkpoints, states, checks of numbers, pulls."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from rl_yardstick.agents.bandits.runs import PullLog
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from rl_yardstick.machine_code import WorkTime
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.critics import CriticRecorder
from rl_yardstick.pipeline.evaluation.judge import Judge
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
from rl_yardstick.pipeline.run import LAST_PULLS, PULLS_FILE, Run
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.pipeline.states import load_state, roots_of, save_state

# --- checkpoints, and exploration that decays per update ------------------------------------------


class StepCheckpoint(BlockCallback):
    """Saves ``rl_model_<steps>_steps.zip`` every ``every_n_steps`` steps of all environments."""

    def __init__(self, run: Run, every_n_steps: int, with_replay_buffer: bool = False) -> None:
        super().__init__()
        self.run, self.every_n_steps = run, every_n_steps
        self.with_replay_buffer = with_replay_buffer

    def _on_step(self) -> bool:
        save_checkpoint(self.run, self.model, self.with_replay_buffer)
        return True


class EpisodeCheckpoint(BlockCallback):
    """Saves a checkpoint every ``every_n_episodes`` episodes of all environments."""

    def __init__(self, run: Run, every_n_episodes: int, with_replay_buffer: bool = False) -> None:
        super().__init__()
        self.run, self.every_n_episodes = run, every_n_episodes
        self.with_replay_buffer = with_replay_buffer
        self.episodes_seen = 0

    def horizon(self) -> Horizon:
        return Horizon(episodes=calls_until_multiple(self.episodes_seen, self.every_n_episodes))

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        super().pass_over(n_calls, n_episodes)
        self.episodes_seen += n_episodes

    def _on_step(self) -> bool:
        before = self.episodes_seen
        self.episodes_seen += int(np.sum(self.locals["dones"]))
        if self.episodes_seen // self.every_n_episodes > before // self.every_n_episodes:
            save_checkpoint(self.run, self.model, self.with_replay_buffer)
        return True


def save_checkpoint(run: Run, model: Any, with_replay_buffer: bool) -> None:
    """Save the current agent, its statistics, and its replay buffer, if that is asked for."""
    steps = model.num_timesteps
    run.save(model, run.path / f"rl_model_{steps}_steps.zip")
    if with_replay_buffer and getattr(model, "replay_buffer", None) is not None:
        with replacing(run.path / f"rl_model_replay_buffer_{steps}_steps.pkl") as beside:
            model.save_replay_buffer(beside)


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
        self.initial_eps, self.final_eps, self.decay = initial_eps, final_eps, decay
        for name in ("initial_eps", "final_eps", "decay"):
            if not 0 <= (value := getattr(self, name)) <= 1:
                raise ValueError(f"{name} must lie between 0 and 1, not {value}")

    def _init_callback(self) -> None:
        if not isinstance(self.model, DQN):
            name = type(self.model).__name__
            raise UserError(f"ExponentialExploration is for DQN and subclasses, not for {name}")

    def _on_rollout_start(self) -> None:
        updates = self.model._n_updates
        epsilon = max(self.final_eps, self.initial_eps * self.decay**updates)
        # The algorithm reads its schedule after each step: it must equal the current rate.
        model: Any = self.model
        model.exploration_schedule = ConstantSchedule(epsilon)
        model.exploration_rate = epsilon

    def _on_step(self) -> bool:
        return True


# --- states ---------------------------------------------------------------------------------------


class StateCallback(BlockCallback):
    """Saves the training's state now and then, and ends the training after a signal.

    Both happen at a safe moment: after the last update and before the next step. At the first one
    of a resumed run, the saved state is put back.

    Attributes:
        others: the other callbacks, whose state is saved too.
        share_of_time: the share of the time that saving may take.
        shortest_pause: seconds between two states.
    """

    takes_blocks = True
    share_of_time, shortest_pause = 0.02, 1.0

    def __init__(self, run: Run, resumes: bool, clock: Any, judge: Judge) -> None:
        super().__init__()
        self.run, self.resumes, self.clock = run, resumes, clock
        self.evaluator = judge.evaluator
        self.process = {"run": run, "exact": judge.exact, "eval_env": judge.env}
        self.is_possible = True
        self.others: list[BaseCallback] = []
        self.saved_at, self.pause = time.monotonic(), self.shortest_pause

    def wants_position(self) -> bool:
        return self.resumes or self._is_due() or bool(self.run.stop.number)

    def _is_due(self) -> bool:
        return self.is_possible and time.monotonic() - self.saved_at >= self.pause

    def _roots(self) -> dict[str, Any]:
        roots = roots_of(self.model, self.others, **self.process)
        is_exact = self.evaluator is self.process["exact"]  # which has no state of its own
        return roots if is_exact else {**roots, "evaluator": self.evaluator}

    def _on_rollout_start(self) -> None:
        if self.resumes:
            load_state(self.run.state_path, self._roots())
            self.resumes = False
            self.run.console.print(f"resuming at step {self.model.num_timesteps:,}")
        elif self._is_due() or (self.is_possible and self.run.stop.number):
            self.save()
        self.run.has_begun = True
        self.run.stop.check()

    def save(self) -> None:
        """Save the state; called between two updates."""
        begun = time.monotonic()
        self.clock.stop()
        try:
            save_state(self.run.state_path, self._roots(), ("logger", *self.process))
        except (TypeError, AttributeError, ValueError, pickle.PicklingError) as error:
            self.is_possible = False
            self.run.console.print(
                f"no state can be saved, so the training cannot be resumed: {one_line(error)}"
            )
        self.saved_at = time.monotonic()
        self.pause = max((self.saved_at - begun) / self.share_of_time, self.shortest_pause)

    def _on_step(self) -> bool:
        return True


# --- numbers that are not finite end a training ---------------------------------------------------

# Log entries of the library's agents. Others may be nan, as the explained variance of constants.
_LOSSES = tuple(
    f"train/{name}" for name in ("loss", "actor_loss", "critic_loss", "ent_coef_loss", "value_loss")
)
_NO_EPISODE: Mapping[str, float] = {"r": 0.0}


class NumberWatch(BlockCallback):
    """Checks the numbers of each step (or of a compiled block's last step) and the losses."""

    takes_blocks = True

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Keep the training loop's variables without a copy, because this runs at each step."""
        self.locals = locals_

    def _on_training_start(self) -> None:
        if self.model._last_obs is not None:
            when = f"at step {self.model.num_timesteps:,}"
            check_rows(self.model._last_obs, "observation", when)

    def _on_rollout_start(self) -> None:
        log = self.model.logger.name_to_value
        for name in _LOSSES:
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

    n_pulls: int  #: over all environments
    n_matched: int  #: pulls with a reward in the log; all pulls without a log
    reward: float | None  #: mean of the matched pulls; None if no pull matched
    #: sum over pulls of the best expected reward minus that of the pulled arm; None if expected
    #: rewards are unknown, as with a log
    regret: float | None
    optimal: float | None  #: share of best arms among the last pulls; None as for ``regret``


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
        with replacing(self.folder / PULLS_FILE) as beside:
            np.savez(beside, allow_pickle=False, **self.arrays())


# --- evaluations during training: when they are due, and what they leave --------------------------

SECONDS_BETWEEN_WRITES = 1.0
EVALUATIONS_PER_RUN = 20


class EvaluationCallback(EvalCallback):
    """An `EvalCallback` with an evaluator of ours: ``evaluations.npz`` and ``best_model.zip``.

    Attributes:
        eval_freq: calls of ``VecEnv.step`` between two evaluations; 0 for none.
        eval_episode_freq: episodes between two evaluations, likewise.
        taken: the time of all evaluations.
        n_episodes: of each evaluation; 0 if it is exact.
    """

    excluded_from_states = ("eval_env", "taken")

    def __init__(
        self,
        run: Run,
        eval_env: VecEnv,
        evaluator: Any,
        frequencies: tuple[int, int],
        value_maps: ValueMapRecorder | None = None,
        critics: CriticRecorder | None = None,
    ) -> None:
        super().__init__(eval_env, eval_freq=frequencies[0], verbose=0)
        self.eval_episode_freq = frequencies[1]
        self.run, self.evaluator = run, evaluator
        self.value_maps, self.critics = value_maps, critics
        self.episodes_seen = 0
        self.best_timesteps = self.best_episodes = 0
        self.taken = WorkTime()
        self.n_episodes: list[int] = []
        self._written_at = -math.inf

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
        """Whether there are evaluations during training."""
        return self.eval_freq > 0 or self.eval_episode_freq > 0

    @property
    def best(self) -> float | None:
        """The best mean return of all evaluations in training."""
        return self.best_mean_reward if self.best_timesteps else None

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
        return self.evaluate() if is_due else True

    def _on_training_end(self) -> None:
        self.write()

    def evaluate(self) -> bool:
        """Evaluate the current agent; False if a callback asks to stop the training."""
        check_model(self.model)
        self.take_statistics()
        begun = WorkTime.now()
        found: Evaluation = self.evaluator(self.model)
        self.taken += WorkTime.now() - begun
        self.last_mean_reward = found.mean_return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(found.returns.tolist())
        self.evaluations_length.append(found.lengths.tolist())
        if found.successes is not None:
            self.evaluations_successes.append(found.successes.tolist())
        self.n_episodes.append(0 if found.is_exact else len(found.returns))
        # Replacing a file takes longer than an exact evaluation.
        if not 0 <= time.monotonic() - self._written_at < SECONDS_BETWEEN_WRITES:
            self.write()
        if self.value_maps is not None:
            self.value_maps.count(self.model)
        if self.critics is not None:
            self.critics.judge(self.num_timesteps)
        self._log(found)
        if found.mean_return > self.best_mean_reward:
            self.best_mean_reward = found.mean_return
            self.best_timesteps, self.best_episodes = self.num_timesteps, self.n_episodes[-1]
            self.run.save(self.model, self.run.best_model_path)
        return self._on_event() if self.callback is not None else True

    def take_statistics(self) -> None:
        """Copy training's current normalisation statistics to evaluation."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)

    def write(self) -> None:
        """Write ``evaluations.npz``."""
        if not self.evaluations_timesteps:
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
        with replacing(self.run.path / "evaluations.npz") as beside:
            np.savez(beside, **arrays)
        self._written_at = time.monotonic()

    def _log(self, found: Evaluation) -> None:
        record = self.logger.record
        record("eval/mean_reward", found.mean_return)
        record("eval/mean_ep_length", float(found.lengths.mean()))
        if found.success_rate is not None:
            record("eval/success_rate", found.success_rate)
        if found.yardstick is not None:
            record("eval/gap", found.yardstick.gap(found.mean_return))
            record("eval/score", found.yardstick.score(found.mean_return))
        record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)


def _table(rows: list[list[Any]]) -> NDArray[Any]:
    """Rows as one array, shorter rows repeated; rl_zoo3's plots need at least two columns."""
    width = max(math.lcm(*map(len, rows)), 2)
    return np.array([row * (width // len(row)) for row in rows])


def evaluation_frequencies(
    spec: TrainSpec, agent: BaseAlgorithm, by_regret: bool
) -> tuple[int, int]:
    """Calls of ``VecEnv.step``, and episodes, between two evaluations; 0 for none."""
    if spec.eval_freq is not None:
        return (max(spec.eval_freq // agent.n_envs, 1), 0) if spec.eval_freq > 0 else (0, 0)
    if by_regret:  # evaluation episodes may have other arms: training's pulls tell more
        return 0, 0
    if spec.n_timesteps is not None:
        return max(spec.n_timesteps // EVALUATIONS_PER_RUN // agent.n_envs, 1), 0
    return 0, -(-(spec.n_episodes or 1) // EVALUATIONS_PER_RUN)
