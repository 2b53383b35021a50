"""What is told of a training's steps: evaluations, checkpoints, pulls, and what settings name."""

from __future__ import annotations

from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.common.callback_horizons import EpisodeBudget
from pipeline.callbacks import EpisodeCheckpoint, ExponentialExploration, StepCheckpoint
from pipeline.errors import UserError
from pipeline.evaluation.exact import ExactEvaluator
from pipeline.evaluation.sampled import SampledEvaluator
from pipeline.evaluation.value_maps import ValueMapRecorder
from pipeline.evaluation_callback import EvaluationCallback
from pipeline.progress import ProgressDisplay
from pipeline.pull_recording import PullRecorder
from pipeline.runs import Run
from pipeline.settings import components
from pipeline.train_spec import TrainSpec

EVALUATIONS_PER_RUN = 20


def all_callbacks(
    spec: TrainSpec, callbacks: list[BaseCallback], display: ProgressDisplay
) -> CallbackList:
    """All callbacks: those that are there in any case, the budget, and what shows the progress."""
    if spec.hyperparams.n_episodes is not None:
        callbacks.append(EpisodeBudget(spec.hyperparams.n_episodes))
    if spec.verbose > 0:
        callbacks.append(display)
    return CallbackList(callbacks)


def evaluation_callback(
    spec: TrainSpec,
    run: Run,
    eval_env: VecEnv,
    n_envs: int,
    is_bandit: bool,
    exact: ExactEvaluator | None,
    display: ProgressDisplay,
) -> EvaluationCallback:
    """The evaluations during training: exact ones where they can be."""
    return EvaluationCallback(
        run,
        eval_env,
        exact or SampledEvaluator(spec, eval_env),
        *_evaluation_intervals(spec, n_envs, is_judged_by_regret=exact is None and is_bandit),
        value_maps=None if exact is None else ValueMapRecorder(run.value_maps_path, exact),
        during=display.doing,
    )


def named_callbacks(spec: TrainSpec, run: Run, model: BaseAlgorithm) -> list[BaseCallback]:
    """The callbacks that the hyperparameters name, and the checkpoints that are asked for."""
    callbacks: list[BaseCallback] = components.callbacks(
        spec.hyperparams.callback, spec.gym_packages, run.path
    )
    _check_callbacks(spec, model, callbacks)
    if spec.save_freq > 0:
        callbacks.append(StepCheckpoint(spec.save_freq, run.path, spec.save_replay_buffer))
    if spec.save_every_n_episodes > 0:
        every = spec.save_every_n_episodes
        callbacks.append(EpisodeCheckpoint(every, run.path, spec.save_replay_buffer))
    return callbacks


def pull_recorder(model: BaseAlgorithm, run: Run, console: Console) -> PullRecorder | None:
    """What keeps every pull, unless a compiled loop was asked for, which does not stop at each."""
    if getattr(model, "engine", None) == "compiled":
        console.print("engine: compiled keeps no pulls, so that regret is not known", style="dim")
        return None
    return PullRecorder(run.path)


def _check_callbacks(spec: TrainSpec, model: BaseAlgorithm, callbacks: list[BaseCallback]) -> None:
    """Refuse now what would end the training half-way."""
    for callback in callbacks:
        if isinstance(callback, ExponentialExploration):
            callback.check_model(model)
    by_episodes = spec.hyperparams.n_episodes is not None
    if by_episodes and isinstance(model, OnPolicyAlgorithm) and _has_moving_schedule(model):
        raise UserError(
            f"the schedules of {spec.algo} run by steps: give n_timesteps instead of n_episodes, "
            "or constant values"
        )


def _has_moving_schedule(model: BaseAlgorithm) -> bool:
    schedules = [getattr(model, name, None) for name in ("lr_schedule", "clip_range")]
    return any(callable(s) and s(1.0) != s(0.0) for s in schedules)


def _evaluation_intervals(
    spec: TrainSpec, n_envs: int, is_judged_by_regret: bool
) -> tuple[int, int]:
    """Calls of `VecEnv.step`, and episodes, between two evaluations; 0 for none."""
    if spec.eval_freq is not None:
        return (max(spec.eval_freq // n_envs, 1), 0) if spec.eval_freq > 0 else (0, 0)
    if is_judged_by_regret:
        # An episode to evaluate on may have other arms, and says less than the pulls of training.
        return 0, 0
    if spec.hyperparams.n_timesteps is not None:
        return max(spec.hyperparams.n_timesteps // EVALUATIONS_PER_RUN // n_envs, 1), 0
    return 0, -(-(spec.hyperparams.n_episodes or 1) // EVALUATIONS_PER_RUN)
