"""From a spec to a finished run folder: `prepare` makes all parts, `carry_out` trains."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

import torch as th
from rich.console import Console

from mdp.machine_code import compile_timer
from pipeline.broken_runs import blame_weights, close, give_up
from pipeline.errors import UserError, one_line
from pipeline.evaluation.exact import ExactEvaluator
from pipeline.evaluation.sampled import Evaluation, evaluate, evaluation_seed
from pipeline.evaluation.value_maps import value_map
from pipeline.files import naming
from pipeline.models.companions import final_replay_buffer_path
from pipeline.models.model_saving import save_model, save_normalization, save_replay_buffer
from pipeline.pictures.learning_curve import draw_learning_curve
from pipeline.pictures.pull_curve import draw_pulls
from pipeline.pictures.value_map import draw_value_map
from pipeline.preparation import Training, algorithm_kwargs, is_unread, set_up
from pipeline.pull_recording import PullSummary, summarise_pulls
from pipeline.run_folder import FINISHED, INTERRUPTED, RUNNING, Run
from pipeline.run_record import recorded_versions, write_arguments, write_settings
from pipeline.signs_of_life import Activity, doing
from pipeline.train_spec import TrainSpec

FINAL_EVALUATION_EPISODES = 100
# A budget in episodes has no number of steps; this one is never reached.
UNBOUNDED_TIMESTEPS = 10**12


@dataclass(frozen=True)
class Outcome:
    """What came out of a run.

    Attributes:
        run: its folder.
        state: ``"finished"`` or ``"interrupted"``.
        n_steps: environment steps that were run.
        seconds: time that they took, evaluations included, and compiling, which is done once, not.
        final: evaluation of the agent at the end, by episodes used for nothing else; None where
            evaluation was turned off.
        best_return: mean return of the best evaluation during training, if there was one.
        best_timesteps: when that was.
        engine: for tabular agents, whether training was compiled, and if not, why.
        pulls: on bandits, figures on the pulls of training; else None.
    """

    run: Run
    state: str
    n_steps: int
    seconds: float
    final: Evaluation | None
    best_return: float | None
    best_timesteps: int
    engine: str | None
    pulls: PullSummary | None = None


def train(
    spec: TrainSpec, console: Console, args: dict[str, Any], command: str, run: Run | None = None
) -> Outcome:
    """Train the agent and leave a run folder: `prepare`, then `carry_out`."""
    return carry_out(prepare(spec, console, args, command, run))


def prepare(
    spec: TrainSpec, console: Console, args: dict[str, Any], command: str, run: Run | None = None
) -> Training:
    """Make the run folder and all parts of the training.

    Args:
        spec: what to do.
        console: where the training is to report to.
        args: the command's arguments, for the run folder.
        command: the command itself, likewise.
        run: the run folder, made already; by default a new one in the spec's log folder.

    Raises:
        UserError: if the spec does not work out; no folder is left behind then.
    """
    if spec.num_threads > 0:
        th.set_num_threads(spec.num_threads)
    kwargs = algorithm_kwargs(spec)
    suffix = f"_{uuid4()}" if spec.unique_id else ""
    if run is None:
        run = Run.claim(spec.log_folder, spec.algo, spec.env_id, suffix)
    with ExitStack() as undo, _library_errors_in_one_line(), naming(run.path):
        undo.callback(run.discard)
        run.keep_room()
        training = set_up(spec, run, kwargs, console, undo)
        spec = training.spec  # with what an agent that goes on has brought along
        write_settings(run, spec, command)
        write_arguments(run, spec, args)
        run.update_info(
            state=RUNNING,
            env_name=run.env_name,
            spec=spec.as_data(),
            versions=recorded_versions(),
            **({} if training.refusal is None else {"model_refused": training.refusal}),
        )
        undo.pop_all()
    return training


@contextmanager
def _library_errors_in_one_line() -> Iterator[None]:
    """Errors of settings that only the library checks, when it gets them."""
    try:
        yield
    except (ValueError, TypeError, AssertionError, RuntimeError, MemoryError) as error:
        raise UserError(one_line(error)) from error


def carry_out(training: Training) -> Outcome:
    """Train, and save, judge and draw what was learnt.

    Ctrl-C ends the training early; what was learnt until then is saved all the same.

    Raises:
        UserError: if the agent finds at its first step that it cannot work so; no folder is left
            behind then.
    """
    started = time.monotonic()
    state = FINISHED
    try:
        with naming(training.run.path), compile_timer() as seconds_compiling:
            try:
                _learn(training)
            except KeyboardInterrupt:
                state = INTERRUPTED
            finally:
                training.display.close()
            seconds = time.monotonic() - started - seconds_compiling()
        with (
            naming(training.run.path),
            doing(training.display.console, "saving what was learnt") as activity,
        ):
            outcome = _finish(training, state, seconds, activity)
    except BaseException as error:
        with contextlib.suppress(OSError):  # what could not be written still cannot
            close(training)
        give_up(training, error)
        raise
    close(training)
    return outcome


def _learn(training: Training) -> None:
    spec = training.spec
    kwargs: dict[str, Any] = {}
    if is_unread(spec):
        kwargs["log_interval"] = None
    elif spec.log_interval != -1:
        kwargs["log_interval"] = spec.log_interval if spec.log_interval > 0 else None
    try:
        training.model.learn(
            spec.hyperparams.n_timesteps or UNBOUNDED_TIMESTEPS,
            callback=training.callback,
            tb_log_name=spec.algo,
            reset_num_timesteps=spec.trained_agent is None,
            **kwargs,
        )
    except (ValueError, RuntimeError) as error:
        blame_weights(training.model, error)
        raise


def _finish(training: Training, state: str, seconds: float, activity: Activity) -> Outcome:
    """Save what was learnt, judge it, draw it; ``run.json`` says so when all else is there."""
    run, model, evaluation = training.run, training.model, training.evaluation
    save_model(model, run.model_path)
    save_normalization(model, run.vecnormalize_path)
    if training.spec.save_replay_buffer:
        save_replay_buffer(model, final_replay_buffer_path(run.path))
    activity.now("evaluating the final policy")
    if evaluation.is_asked_for and not evaluation.evaluations_timesteps:
        # The run was shorter than the time to its first evaluation, or called no callback.
        evaluation.init_callback(model)
        evaluation.evaluate_now()
    final = _final_evaluation(training) if state == FINISHED else None
    title = f"{training.spec.algo} on {run.env_name}, seed {training.spec.seed}"
    activity.now("drawing the pictures")
    pulls = _keep_pulls(training, state, title)
    if training.spec.pictures and (pulls is None or evaluation.evaluations_timesteps):
        yardstick = None if final is None else final.yardstick
        first_step, on_variant = model._num_timesteps_at_start, training.display.on_variant
        draw_learning_curve(run, title, first_step, yardstick, on_variant=on_variant)
    _keep_value_map(training, title)
    outcome = Outcome(
        run,
        state,
        n_steps=model.num_timesteps,
        seconds=seconds,
        final=final,
        best_return=evaluation.best_mean_reward if evaluation.best_timesteps else None,
        best_timesteps=evaluation.best_timesteps,
        engine=getattr(model, "engine_in_use", None),
        pulls=pulls,
    )
    _record(outcome)
    return outcome


def _record(outcome: Outcome) -> None:
    """Write what came out into ``run.json``, the last file of a run."""
    pulls = outcome.pulls
    outcome.run.end(
        state=outcome.state,
        n_timesteps=outcome.n_steps,
        seconds=round(outcome.seconds, 3),
        final=None if outcome.final is None else outcome.final.summary(),
        best_mean_return=outcome.best_return,
        best_timesteps=outcome.best_timesteps,
        engine=outcome.engine,
        **({} if pulls is None else {"regret": pulls.regret, "pulls": pulls.as_data()}),
    )


def _keep_pulls(training: Training, state: str, title: str) -> PullSummary | None:
    """Sum up and draw the pulls, on bandits."""
    recorder = training.pulls
    if recorder is None or not recorder.n_calls:
        return None
    if state == INTERRUPTED:
        recorder.write()  # as it does by itself where the training was not interrupted
    arrays = recorder.arrays()
    if training.spec.pictures:
        draw_pulls(training.run.pulls_picture_path, title, arrays)
    return summarise_pulls(arrays)


def _keep_value_map(training: Training, title: str) -> None:
    """Record and draw the final policy, where evaluation is on and knows a map."""
    model, maps = training.model, training.evaluation.value_maps
    if maps is None or not training.evaluation.is_asked_for:
        return
    maps.finish(model, model.num_timesteps)
    found = value_map(maps.evaluator, model) if training.spec.pictures else None
    if found is not None:
        draw_value_map(training.run.value_map_path, title, found)


def _final_evaluation(training: Training) -> Evaluation | None:
    """Exact, or by episodes that were used for nothing else; none where evaluation is off."""
    evaluator = training.evaluation.evaluator
    if not training.evaluation.is_asked_for:
        return None
    training.evaluation.take_statistics()
    if isinstance(evaluator, ExactEvaluator):
        return evaluator(training.model)
    return evaluate(
        training.model,
        training.eval_env,
        FINAL_EVALUATION_EPISODES,
        evaluation_seed(training.spec.seed, 2),
    )
