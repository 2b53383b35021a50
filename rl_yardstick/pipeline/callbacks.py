"""Callbacks of a training: evaluations, checkpoints, states, pulls, progress, time."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import sync_envs_normalization

from rl_yardstick.agents.bandits.runs import PullLog
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from rl_yardstick.machine_code import WorkTime
from rl_yardstick.pipeline.errors import one_line
from rl_yardstick.pipeline.evaluation.critics import CriticRecorder
from rl_yardstick.pipeline.evaluation.judge import Judge
from rl_yardstick.pipeline.evaluation.sampled import SampledEvaluator
from rl_yardstick.pipeline.evaluation.value_maps import ValueMapRecorder
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.finite_numbers import check_model
from rl_yardstick.pipeline.run import LAST_PULLS, PULLS_FILE, Run, save_agent
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.pipeline.states import load_state, roots_of, save_state

# --- checkpoints, and exploration that decays per update ------------------------------------------


class Checkpoint(BlockCallback):
    """Saves ``rl_model_<steps>_steps.zip`` every so many steps or episodes of all environments."""

    def __init__(
        self,
        every_n_steps: int | None = None,
        every_n_episodes: int = 0,
        save_path: str = "",
        with_replay_buffer: bool = False,
    ) -> None:
        super().__init__()
        self.every_n_steps, self.every_n_episodes = every_n_steps, every_n_episodes
        self.folder, self.with_replay_buffer = Path(save_path), with_replay_buffer
        self.episodes_seen = 0

    def horizon(self) -> Horizon:
        if self.every_n_steps is not None:
            return super().horizon()
        return Horizon(episodes=calls_until_multiple(self.episodes_seen, self.every_n_episodes))

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        super().pass_over(n_calls, n_episodes)
        self.episodes_seen += n_episodes

    def _on_step(self) -> bool:
        if self.every_n_steps is None:
            before = self.episodes_seen
            self.episodes_seen += int(np.sum(self.locals["dones"]))
            if self.episodes_seen // self.every_n_episodes == before // self.every_n_episodes:
                return True
        steps = f"{self.num_timesteps}_steps"
        buffer = self.folder / f"rl_model_replay_buffer_{steps}.pkl"
        path = self.folder / f"rl_model_{steps}.zip"
        save_agent(self.model, path, buffer if self.with_replay_buffer else None)
        return True


class ExponentialExploration(BaseCallback):
    """Multiplies DQN's epsilon by ``decay`` at each gradient update; all arguments in [0, 1]."""

    def __init__(
        self, initial_eps: float = 1.0, final_eps: float = 0.01, decay: float = 0.995
    ) -> None:
        super().__init__()
        self.initial_eps, self.final_eps, self.decay = initial_eps, final_eps, decay

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        epsilon = max(self.final_eps, self.initial_eps * self.decay**model._n_updates)
        # The algorithm reads its schedule after each step: it must equal the current rate.
        model.exploration_schedule = ConstantSchedule(epsilon)
        model.exploration_rate = epsilon

    def _on_step(self) -> bool:
        return True


# --- states, time and progress --------------------------------------------------------------------


class StateCallback(BlockCallback):
    """Saves the training's state now and then, and ends the training after a signal.

    Both happen at a safe moment: after the last update and before the next step. At the first one
    of a resumed run, the saved state is put back.

    The state includes that of the ``others``.
    """

    takes_blocks = True
    share_of_time = 0.02  # that saving may take
    shortest_pause = 1.0  # seconds between two states

    def __init__(
        self, run: Run, resumes: bool, judge: Judge, others: list[BaseCallback], clock: Any
    ) -> None:
        super().__init__()
        self.run, self.resumes, self.others, self.clock = run, resumes, others, clock
        self.process = {"run": run, "exact": judge.exact, "eval_env": judge.env}
        self.evaluator = None if judge.exact is not None else judge.evaluator
        self.is_possible = True
        self.due_at = time.monotonic() + self.shortest_pause

    def wants_position(self) -> bool:
        is_due = self.is_possible and time.monotonic() >= self.due_at
        return self.resumes or is_due or bool(self.run.stop.number)

    def _on_rollout_start(self) -> None:
        if self.resumes:
            load_state(self.run.state_path, self._roots())
            self.resumes = False
            self.run.console.print(f"resuming at step {self.model.num_timesteps:,}")
        elif self.is_possible and self.wants_position():
            self._save()
        self.run.has_begun = True
        self.run.stop.check()

    def _roots(self) -> dict[str, Any]:
        return roots_of(self.model, self.others, **self.process, evaluator=self.evaluator)

    def _save(self) -> None:
        begun = time.monotonic()
        self.clock.read_clock()
        try:
            save_state(self.run.state_path, self._roots(), ("logger", *self.process))
        except (TypeError, AttributeError, ValueError, pickle.PicklingError) as error:
            self.is_possible = False
            self.run.console.print(
                f"no state can be saved, so the training cannot be resumed: {one_line(error)}"
            )
        now = time.monotonic()
        self.due_at = now + max((now - begun) / self.share_of_time, self.shortest_pause)

    def _on_step(self) -> bool:
        return True


UPDATES = 400  # of a training's bar
SECONDS_BETWEEN_LINES = 10.0


class ProgressCallback(BlockCallback):
    """Tells the steps and the mean return of training's last episodes, and takes the time.

    Attributes:
        taken: the time of training over all its starts, without compiling.
    """

    excluded_from_states = ("console", "bar", "task", "told_at", "_begun", "_compiling")

    def __init__(self, console: Console, n_timesteps: int, on_variant: bool = False) -> None:
        super().__init__()
        self.console, self.taken = console, WorkTime()
        self.where = "training (on a variant)" if on_variant else "training"
        # A block of compiled training ends where a callback acts: nobody reads a quiet console.
        few = min(max(n_timesteps // UPDATES, 1), 20_000)
        self.every_n_steps = max(n_timesteps, 1) if console.quiet else few
        columns = BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
        text, is_live = TextColumn("{task.description}"), console.is_terminal and not console.quiet
        self.bar = Progress(*columns, text, console=console, transient=True, disable=not is_live)
        self.task = self.bar.add_task("", total=1.0)

    def start_clock(self, time_compiling: Callable[[], WorkTime]) -> None:
        """Begin to count the time."""
        self._begun, self._compiling = WorkTime.now() - time_compiling(), time_compiling

    def read_clock(self) -> None:
        """Add the time since the start, and go on counting from here."""
        now = WorkTime.now() - self._compiling()
        self.taken, self._begun = self.taken + (now - self._begun), now

    def _on_training_start(self) -> None:
        self.told_at = time.monotonic()
        self.bar.start()

    def _on_step(self) -> bool:
        share = min(self.num_timesteps / max(self.model._total_timesteps, 1), 1.0)
        if self.bar.disable and time.monotonic() - self.told_at <= SECONDS_BETWEEN_LINES:
            return True
        figures = f"{self.num_timesteps:,} steps"
        if episodes := self.model.ep_info_buffer:
            mean = np.mean([episode["r"] for episode in episodes])
            figures += f"  mean return in {self.where} {mean:.2f}"
        self.bar.update(self.task, completed=share, description=figures)
        if self.bar.disable:
            self.told_at = time.monotonic()
            self.console.print(f"{share:4.0%}  {figures}", highlight=False)
        return True

    def _on_training_end(self) -> None:
        self.bar.stop()  # gives the terminal back; may be called repeatedly


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


class PullRecorder(PullLog):
    """Writes ``pulls.npz`` at the end of training, with the contents of `PullLog.arrays`."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_training_end(self) -> None:
        with replacing(self.folder / PULLS_FILE) as beside:
            np.savez(beside, allow_pickle=False, **self.arrays())

    def summary(self) -> PullSummary:
        """The summary of all pulls."""
        pulls = self.arrays()
        regrets, matched = pulls["regrets"], pulls["matched"]
        is_known, rewards = not bool(np.isnan(regrets).any()), pulls["rewards"][matched]
        return PullSummary(
            n_pulls=int(regrets.size),
            n_matched=int(matched.sum()),
            reward=float(rewards.mean(dtype=np.float64)) if rewards.size else None,
            regret=float(regrets.sum()) if is_known else None,
            optimal=float(pulls["optimal"][:, -LAST_PULLS:].mean()) if is_known else None,
        )


# --- evaluations during training: when they are due, and what they leave --------------------------

SECONDS_BETWEEN_WRITES = 1.0
EVALUATIONS_PER_RUN = 20


class EvaluationCallback(EvalCallback):
    """An `EvalCallback` with an evaluator of ours: ``evaluations.npz`` and ``best_model.zip``.

    Attributes:
        eval_freq: calls of ``VecEnv.step`` between two evaluations; 0 for none.
        eval_episode_freq: episodes between two evaluations, likewise.
    """

    excluded_from_states = ("eval_env", "taken", "_written_at")

    def __init__(
        self,
        run: Run,
        judge: Judge,
        frequencies: tuple[int, int],
        value_maps: ValueMapRecorder | None = None,
        critics: CriticRecorder | None = None,
    ) -> None:
        super().__init__(judge.env, eval_freq=frequencies[0], verbose=0)
        self.eval_episode_freq = frequencies[1]
        self.is_asked_for = max(frequencies) > 0
        self.run, self.evaluator = run, judge.evaluator
        self.value_maps, self.critics = value_maps, critics
        self.best: float | None = None  # mean return of all evaluations
        self.episodes_seen = self.best_timesteps = self.best_episodes = 0
        self.taken = WorkTime()  # by all evaluations
        self.n_episodes: list[int] = []  # of each evaluation; 0 if it is exact
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

    def _init_callback(self) -> None:
        """Skip the library's check that training and evaluation environments have one type."""

    def _on_step(self) -> bool:
        before = self.episodes_seen
        self.episodes_seen += int(np.sum(self.locals["dones"]))
        is_due = self.eval_freq > 0 and self.n_calls % self.eval_freq == 0
        if every := self.eval_episode_freq:
            is_due |= self.episodes_seen // every > before // every
        if is_due and isinstance(self.evaluator, SampledEvaluator):
            is_due = self.evaluator.can_afford(self.model, self.episodes_seen)
        if is_due:
            self.evaluate()
        return True

    def _on_training_end(self) -> None:
        self.write()

    def evaluate(self, found: Evaluation | None = None) -> None:
        """Add a point to the curve: an evaluation of the current agent, unless one is given."""
        check_model(self.model)
        found = found or self.timed(self.evaluator)
        self.last_mean_reward = found.mean_return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(found.returns.tolist())
        self.evaluations_length.append(found.lengths.tolist())
        if found.successes is not None:
            self.evaluations_successes.append(found.successes.tolist())
        self.n_episodes.append(0 if found.is_exact else len(found.returns))
        # Replacing a file takes longer than an exact evaluation.
        if time.monotonic() - self._written_at >= SECONDS_BETWEEN_WRITES:
            self.write()
        if self.value_maps is not None:
            self.value_maps.count(self.model)
        if self.critics is not None:
            self.critics.judge(self.num_timesteps)
        scale, mean = found.yardstick, found.mean_return
        logged = {"mean_reward": mean, "mean_ep_length": float(found.lengths.mean())}
        logged |= {} if found.success_rate is None else {"success_rate": found.success_rate}
        logged |= {} if scale is None else {"gap": scale.gap(mean), "score": scale.score(mean)}
        for name, value in logged.items():
            self.logger.record(f"eval/{name}", value)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        self.keep_if_best(found)

    def keep_if_best(self, found: Evaluation) -> None:
        """Save the current agent, if no earlier one was evaluated as good."""
        if found.mean_return > self.best_mean_reward:
            self.best = self.best_mean_reward = found.mean_return
            self.best_timesteps = self.model.num_timesteps
            self.best_episodes = 0 if found.is_exact else len(found.returns)
            save_agent(self.model, self.run.best_model_path)

    def timed(self, evaluator: Callable[[BaseAlgorithm], Evaluation]) -> Evaluation:
        """Evaluate the agent with training's current normalisation statistics; its time counts."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        begun = WorkTime.now()
        found = evaluator(self.model)
        self.taken += WorkTime.now() - begun
        return found

    def write(self) -> None:
        """Write ``evaluations.npz``."""
        if not self.evaluations_timesteps:
            return

        def table(rows: list[list[Any]]) -> NDArray[Any]:
            # Shorter rows are repeated; rl_zoo3's plots need at least two columns.
            width = max(math.lcm(*map(len, rows)), 2)
            return np.array([row * (width // len(row)) for row in rows])

        arrays: dict[str, Any] = {
            "timesteps": self.evaluations_timesteps,
            "results": table(self.evaluations_results),
            "ep_lengths": table(self.evaluations_length),
        }
        if self.evaluations_successes:
            arrays["successes"] = table(self.evaluations_successes)
        if len(set(self.n_episodes)) > 1:
            arrays["n_episodes"] = self.n_episodes
        with replacing(self.run.path / "evaluations.npz") as beside:
            np.savez(beside, **arrays)
        self._written_at = time.monotonic()


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
