"""From a spec to a finished run folder."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import Any
from uuid import uuid4

import torch as th
import yaml
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents import load_algorithm
from agents.blocks import EpisodeBudget
from pipeline import components
from pipeline.algorithm_kwargs import build_algorithm_kwargs
from pipeline.callbacks import (
    EvaluationCallback,
    ExponentialExploration,
    StepCheckpoint,
    save_model,
    save_normalization,
)
from pipeline.environments import make_evaluation_env, make_training_env
from pipeline.errors import UserError, one_line
from pipeline.evaluation import Evaluation, evaluate, evaluation_seed
from pipeline.exact import ExactEvaluator, exact_evaluator
from pipeline.files import write_text
from pipeline.loading import load_model
from pipeline.plots import draw_learning_curve
from pipeline.progress import ProgressDisplay
from pipeline.run import FAILED, FINISHED, INTERRUPTED, RUNNING, Run
from pipeline.specs import TrainSpec
from pipeline.summary import print_header

FINAL_EVALUATION_EPISODES = 100
EVALUATIONS_PER_RUN = 20
# A budget in episodes has no number of steps; this one is never reached.
UNBOUNDED_TIMESTEPS = 10**12

RECORDED_PACKAGES = ("rl-yardstick", "stable-baselines3", "gymnasium", "torch", "numpy", "numba")


@dataclass(frozen=True)
class Training:
    """A run that is set up and can be started.

    Attributes:
        spec: what was asked for.
        run: its folder.
        model: the agent, with its environments.
        eval_env: environments to evaluate on.
        evaluation: the evaluation callback, also part of ``callback``.
        callback: all callbacks.
    """

    spec: TrainSpec
    run: Run
    model: BaseAlgorithm
    eval_env: VecEnv
    evaluation: EvaluationCallback
    display: ProgressDisplay
    callback: BaseCallback


@dataclass(frozen=True)
class Outcome:
    """What a run has come to.

    Attributes:
        run: its folder.
        state: ``"finished"`` or ``"interrupted"``.
        n_steps: environment steps that were run.
        seconds: time that they took, evaluations included.
        final: evaluation of the agent at the end, by episodes that served nothing else; None where
            evaluation was turned off.
        best_return: mean return of the best evaluation during training, if there was one.
        best_timesteps: when that was.
    """

    run: Run
    state: str
    n_steps: int
    seconds: float
    final: Evaluation | None
    best_return: float | None
    best_timesteps: int


def train(spec: TrainSpec, console: Console, args: dict[str, Any], command: str) -> Outcome:
    """Train the agent and leave a run folder.

    Ctrl-C ends the training early; what has been learnt is saved all the same.

    Args:
        spec: what to do.
        console: where to report to.
        args: the command's arguments, for the run folder.
        command: the command itself, likewise.

    Raises:
        UserError: if the spec does not work out; no folder is left behind then.
    """
    th.set_num_threads(spec.num_threads)
    kwargs = algorithm_kwargs(spec)
    suffix = f"_{uuid4()}" if spec.unique_id else ""
    run = Run.claim(spec.log_folder, spec.algo, spec.env_id, suffix)
    with ExitStack() as undo, _library_errors_in_one_line():
        undo.callback(run.discard)
        training = _set_up(spec, run, kwargs, console, undo)
        _write_settings(training, args, command)
        undo.pop_all()
    print_header(console, spec)
    return _execute(training)


def algorithm_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """The arguments of the agent's constructor, checked and made into objects.

    Raises:
        UserError: if one is unknown or has a wrong type or range.
    """
    return build_algorithm_kwargs(
        load_algorithm(spec.algo), spec.hyperparams.algorithm, spec.algo, spec.gym_packages
    )


@contextmanager
def _library_errors_in_one_line() -> Iterator[None]:
    """Settings that only the library finds fault with, when it is handed them."""
    try:
        yield
    except (ValueError, TypeError, AssertionError, RuntimeError) as error:
        raise UserError(one_line(error)) from error


def _set_up(
    spec: TrainSpec, run: Run, kwargs: dict[str, Any], console: Console, undo: ExitStack
) -> Training:
    """Make all parts of the training; ``undo`` is told how to take them back."""
    env = make_training_env(spec, run.path)
    undo.callback(env.close)
    model = _make_model(spec, env, kwargs)
    if _is_unread(spec):
        model.set_logger(Logger(folder=None, output_formats=[]))
    eval_env = make_evaluation_env(spec, min(spec.n_eval_envs, spec.eval_episodes))
    undo.callback(eval_env.close)
    exact = exact_evaluator(spec)
    evaluation = EvaluationCallback(
        run,
        eval_env,
        exact
        or partial(
            evaluate,
            env=eval_env,
            n_episodes=spec.eval_episodes,
            seed=evaluation_seed(spec.seed, 1),
        ),
        _evaluation_interval(spec, env.num_envs),
    )
    display = ProgressDisplay(console, live=spec.progress or console.is_terminal)
    callbacks: list[BaseCallback] = components.callbacks(
        spec.hyperparams.callback, spec.gym_packages, run.path
    )
    _check_callbacks(spec, model, callbacks)
    if spec.save_freq > 0:
        callbacks.append(StepCheckpoint(spec.save_freq, run.path))
    callbacks.append(evaluation)
    if spec.hyperparams.n_episodes is not None:
        callbacks.append(EpisodeBudget(spec.hyperparams.n_episodes))
    if spec.verbose > 0:
        callbacks.append(display)
    return Training(spec, run, model, eval_env, evaluation, display, CallbackList(callbacks))


def _is_unread(spec: TrainSpec) -> bool:
    """Whether nobody reads the library's log, so that its figures need not be worked out."""
    return spec.tensorboard_log is None and spec.verbose < 2


def _check_callbacks(spec: TrainSpec, model: BaseAlgorithm, callbacks: list[BaseCallback]) -> None:
    """Find out now what would end the training half-way."""
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


def _make_model(spec: TrainSpec, env: VecEnv, kwargs: dict[str, Any]) -> BaseAlgorithm:
    common: dict[str, Any] = {
        "seed": spec.seed,
        "verbose": max(spec.verbose - 1, 0),
        "tensorboard_log": None
        if spec.tensorboard_log is None
        else str(spec.tensorboard_log / spec.env_id),
    }
    if spec.trained_agent is None:
        return load_algorithm(spec.algo)(env=env, device=spec.device, **common, **kwargs)
    # The networks are those of the file: their shape cannot change.
    kwargs = {k: v for k, v in kwargs.items() if k not in ("policy", "policy_kwargs")}
    return load_model(spec.algo, spec.trained_agent, env, device=spec.device, **common, **kwargs)


def _evaluation_interval(spec: TrainSpec, n_envs: int) -> int:
    """Calls of `VecEnv.step` between two evaluations; 0 for none."""
    if spec.eval_freq is not None:
        return max(spec.eval_freq // n_envs, 1) if spec.eval_freq > 0 else 0
    n_timesteps = spec.hyperparams.n_timesteps
    if n_timesteps is None:
        return 10_000 // n_envs
    return max(n_timesteps // EVALUATIONS_PER_RUN // n_envs, 1)


def _write_settings(training: Training, args: dict[str, Any], command: str) -> None:
    """Write what the run was asked to do, as rl_zoo3 does and as our own ``run.json``."""
    run, spec = training.run, training.spec
    write_text(run.params_path / "config.yml", yaml.safe_dump(spec.saved_hyperparams))
    # rl_zoo3 takes this for the mapping that it makes of the flag, and puts it over config.yml.
    args = {**args, "env_kwargs": spec.saved_hyperparams.get("env_kwargs")}
    write_text(run.params_path / "args.yml", yaml.safe_dump(args))
    write_text(run.params_path / "command.txt", command + "\n")
    run.update_info(
        state=RUNNING,
        env_name=run.env_name,
        spec=spec.as_data(),
        versions={"python": platform.python_version()}
        | {package: version(package) for package in RECORDED_PACKAGES},
    )


def _execute(training: Training) -> Outcome:
    run, model = training.run, training.model
    started = time.monotonic()
    state = FINISHED
    try:
        try:
            _learn(training)
        except KeyboardInterrupt:
            state = INTERRUPTED
        finally:
            training.display.close()
        return _finish(training, state, time.monotonic() - started)
    except BaseException as error:
        run.update_info(state=FAILED, reason=one_line(error))
        raise
    finally:
        training.eval_env.close()
        if model.env is not None:
            model.env.close()


def _learn(training: Training) -> None:
    spec = training.spec
    kwargs: dict[str, Any] = {}
    if _is_unread(spec):
        kwargs["log_interval"] = None
    elif spec.log_interval != -1:
        kwargs["log_interval"] = spec.log_interval if spec.log_interval > 0 else None
    training.model.learn(
        spec.hyperparams.n_timesteps or UNBOUNDED_TIMESTEPS,
        callback=training.callback,
        reset_num_timesteps=spec.trained_agent is None,
        **kwargs,
    )


def _finish(training: Training, state: str, seconds: float) -> Outcome:
    """Save what was learnt, judge it, draw it; ``run.json`` says so when all else is there."""
    run, model, evaluation = training.run, training.model, training.evaluation
    save_model(model, run.model_path)
    save_normalization(model, run)
    final = _final_evaluation(training) if state == FINISHED else None
    title = f"{training.spec.algo} on {run.env_name}, seed {training.spec.seed}"
    yardstick = None if final is None else final.yardstick
    draw_learning_curve(run, title, model._num_timesteps_at_start, yardstick)
    best = evaluation.best_mean_reward if evaluation.best_timesteps else None
    run.update_info(
        state=state,
        n_timesteps=model.num_timesteps,
        seconds=round(seconds, 3),
        final=None if final is None else final.summary(),
        best_mean_return=best,
        best_timesteps=evaluation.best_timesteps,
        engine=getattr(model, "engine_in_use", None),
    )
    return Outcome(run, state, model.num_timesteps, seconds, final, best, evaluation.best_timesteps)


def _final_evaluation(training: Training) -> Evaluation | None:
    """Exact, or by episodes that have served nothing else; none where evaluation is off."""
    evaluator = training.evaluation.evaluator
    if training.evaluation.eval_freq == 0:
        return None
    if isinstance(evaluator, ExactEvaluator):
        return evaluator(training.model)
    return evaluate(
        training.model,
        training.eval_env,
        FINAL_EVALUATION_EPISODES,
        evaluation_seed(training.spec.seed, 2),
    )
