"""Runs a training from a spec to a finished folder: `prepare`, then `carry_out`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from signal import Signals
from typing import Any

from rich.console import Console

from rl_yardstick.machine_code import WorkTime
from rl_yardstick.machine_code.compiling import compile_timer
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.callbacks import PullSummary, summarise_pulls
from rl_yardstick.pipeline.curve_pictures import draw_diagnosis, draw_learning_curve, draw_pulls
from rl_yardstick.pipeline.environments import titled
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.evaluation.sampled import Evaluation, SampledEvaluator
from rl_yardstick.pipeline.evaluation.value_maps import value_map
from rl_yardstick.pipeline.failures import LibraryError, blame_settings, exits_as_mistakes
from rl_yardstick.pipeline.files import DISK_ERRORS, naming
from rl_yardstick.pipeline.finite_numbers import check_model
from rl_yardstick.pipeline.locks import FolderGoneError, is_gone
from rl_yardstick.pipeline.map_pictures import draw_value_map
from rl_yardstick.pipeline.models.find import REPLAY_BUFFER
from rl_yardstick.pipeline.models.load import save_model, save_normalization, save_replay_buffer
from rl_yardstick.pipeline.preparation import NEW, UNBOUNDED_TIMESTEPS, Training, is_unread, prepare
from rl_yardstick.pipeline.runs import FINISHED, INTERRUPTED, Run, remove_states
from rl_yardstick.pipeline.signs_of_life import Activity, doing
from rl_yardstick.pipeline.state_saver import (
    IterationInterval,
    default_log_interval,
    iterations_before,
)
from rl_yardstick.pipeline.stopping import close_environments, current, deaths_told
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.unfinished_runs import StateKeeping

# After a stop signal: how long the training may continue to the next safe moment, and when
# evaluating and drawing must be finished.
SECONDS_TO_A_SAFE_MOMENT = 1.0
SECONDS_TO_THE_PICTURES = 1.6


@dataclass(frozen=True)
class Outcome:
    """The result of a run."""

    run: Run  #: its folder
    state: str  #: ``"finished"`` or ``"interrupted"``
    n_steps: int  #: environment steps done
    taken: WorkTime  #: the time of training and its evaluations, without compiling
    final: Evaluation | None  #: the final evaluation; None if turned off or interrupted
    best_return: float | None  #: mean return of the best evaluation during training, if any
    best_timesteps: int  #: the time step of that evaluation
    engine: str | None  #: whether training was compiled, and if not, why; None if unknown
    best_episodes: int  #: the number of episodes of that evaluation; 0 if it is exact
    evaluating: WorkTime  #: the time of all evaluations, including the last one
    evaluation_steps: int  #: environment steps of sampled evaluations
    pulls: PullSummary | None = None  #: on bandits, the summary of the training pulls


def train(
    spec: TrainSpec,
    console: Console,
    args: dict[str, Any],
    command: str,
    run: Run | None = None,
    keeping: StateKeeping = NEW,
) -> Outcome:
    """Train the agent and leave a run folder: `prepare`, then `carry_out`."""
    return carry_out(prepare(spec, console, args, command, run, keeping))


def carry_out(training: Training, tell: Callable[[Outcome], object] = lambda _: None) -> Outcome:
    """Train, then save, evaluate and draw the agent, also after a signal ended training early.

    ``tell`` gets the outcome before it is drawn and recorded.

    Raises:
        UserError: if the agent cannot take its first step; then no folder is left behind.
        ForeignExitError: if the environment or a callback asks the program to end.
        KeyboardInterrupt: if it is stopped before the first step, likewise.
    """
    with current().held():
        is_over = False
        try:
            with naming(training.run.path):
                outcome = _train_and_finish(training, tell)
            is_over = True
            close(training)
        except BaseException as error:
            if not is_over:
                with suppress(BaseException):  # it would hide the original error
                    close(training)
            give_up(training, error)
            raise
    return outcome


def _train_and_finish(training: Training, tell: Callable[[Outcome], object]) -> Outcome:
    started = WorkTime.now()
    state = FINISHED
    with compile_timer() as time_compiling:
        try:
            with current().waiting(SECONDS_TO_A_SAFE_MOMENT):
                _learn(training)
        except KeyboardInterrupt:
            if not has_begun(training):
                raise
            state = INTERRUPTED
        finally:
            training.display.close()
        taken = WorkTime.now() - started - time_compiling()
    taken += training.saver.time_before
    with doing(training.display.console, "saving what was learnt") as activity:
        outcome = _judged(training, state, taken, activity)
        tell(outcome)
        outcome = _drawn(training, state, outcome, activity)
    if outcome.state == FINISHED and not training.keeping.stays:
        remove_states(training.run.state_path)
    return outcome


@exits_as_mistakes()
def _learn(training: Training) -> None:
    spec = training.spec
    kwargs: dict[str, Any] = {}
    if is_unread(spec):
        kwargs["log_interval"] = None
    elif spec.log_interval != -1:
        kwargs["log_interval"] = spec.log_interval if spec.log_interval > 0 else None
    begun = training.keeping.state
    interval = kwargs.get("log_interval", default_log_interval(training.model))
    before = 0 if begun is None else iterations_before(training.model, begun.note)
    if before and interval is not None:
        kwargs["log_interval"] = IterationInterval(interval)
        kwargs["log_interval"].before = before
    env = training.model.get_env()
    assert env is not None
    try:
        with deaths_told(env):
            training.model.learn(
                spec.hyperparams.n_timesteps or UNBOUNDED_TIMESTEPS,
                callback=training.callback,
                tb_log_name=spec.algo,
                reset_num_timesteps=spec.trained_agent is None,
                **kwargs,
            )
    except (ArithmeticError, AssertionError, LookupError, RuntimeError, TypeError, ValueError) as e:
        check_model(training.model)  # PyTorch's error for nan in distributions is obscure
        blame_settings(spec.algo, training.model, e)
        raise


def has_begun(training: Training) -> bool:
    """Whether the agent has trained, in this process or earlier ones."""
    model, is_back = training.model, training.saver.state is None
    return is_back and model.num_timesteps > model._num_timesteps_at_start


def _judged(training: Training, state: str, taken: WorkTime, activity: Activity) -> Outcome:
    """Save and evaluate the agent."""
    model, evaluation = training.model, training.evaluation
    pulls = _save(training, state)
    final: Evaluation | None = None
    try:
        with _stoppable(state):
            activity.now("evaluating the final policy")
            final = _judge(training, state)
    except KeyboardInterrupt:
        state = INTERRUPTED
    return Outcome(
        training.run,
        state,
        n_steps=model.num_timesteps,
        taken=taken,
        final=final,
        best_return=evaluation.best_mean_reward if evaluation.best_timesteps else None,
        best_timesteps=evaluation.best_timesteps,
        engine=getattr(model, "engine_in_use", None),
        pulls=pulls,
        best_episodes=evaluation.best_episodes,
        evaluating=evaluation.taken,
        evaluation_steps=getattr(evaluation.evaluator, "n_steps", 0),
    )


def _save(training: Training, state: str) -> PullSummary | None:
    """Save the agent and the pulls; returns the summary of the pulls."""
    run, model, recorder = training.run, training.model, training.pulls
    save_model(model, run.model_path)
    save_normalization(model, run.vecnormalize_path)
    if training.spec.save_replay_buffer and not current().is_urgent:
        save_replay_buffer(model, run.path / REPLAY_BUFFER)
    if recorder is None or not recorder.n_calls:
        return None
    if state == INTERRUPTED:
        recorder.write()  # the recorder does so itself unless the training was interrupted
    return summarise_pulls(recorder.arrays())


def _judge(training: Training, state: str) -> Evaluation | None:
    """Do missing evaluations, and the final one if the training was not interrupted."""
    evaluation, model = training.evaluation, training.model
    if not evaluation.is_asked_for:
        return None
    if not evaluation.evaluations_timesteps:
        # The run was shorter than the first evaluation interval, or called no callback.
        evaluation.init_callback(model)
        evaluation.evaluate_now()
    evaluation.write()
    if evaluation.value_maps is not None:
        evaluation.value_maps.finish(model, model.num_timesteps)
    if evaluation.critics is not None:
        evaluation.critics.finish(model.num_timesteps)
    if state != FINISHED:
        return None
    evaluation.take_statistics()
    with evaluation.timed():
        if isinstance(evaluation.evaluator, SampledEvaluator | ExactEvaluator):
            return evaluation.evaluator.at_the_end(model)
        return evaluation.evaluator(model)


def _drawn(training: Training, state: str, outcome: Outcome, activity: Activity) -> Outcome:
    """Draw the results; then write ``run.json`` as the last file."""
    try:
        with _stoppable(state):
            activity.now("drawing the pictures")
            if training.spec.pictures:
                with loading_libraries():  # Matplotlib
                    draw(training, outcome.final)
    except KeyboardInterrupt:
        if outcome.state == FINISHED:
            activity.say("stopped while drawing: the run counts as interrupted")
        outcome = replace(outcome, state=INTERRUPTED)
    pulls, number = outcome.pulls, current().number
    outcome.run.end(
        state=outcome.state,
        n_timesteps=outcome.n_steps,
        final=None if outcome.final is None else outcome.final.summary(),
        best_mean_return=outcome.best_return,
        best_timesteps=outcome.best_timesteps,
        best_episodes=outcome.best_episodes,
        evaluation_steps=outcome.evaluation_steps,
        engine=outcome.engine,
        **outcome.taken.as_data(),
        **({"stopped_by": Signals(number).name} if number and outcome.state == INTERRUPTED else {}),
        **({} if pulls is None else {"regret": pulls.regret, "pulls": asdict(pulls)}),
    )
    return outcome


@contextmanager
def _stoppable(state: str) -> Iterator[None]:
    """Let a signal end the block at once, or after a time limit if one has ended training."""
    seconds_left = SECONDS_TO_THE_PICTURES if state == INTERRUPTED else 0.0
    with current().waiting(seconds_left), exits_as_mistakes():
        yield


def draw(training: Training, final: Evaluation | None) -> None:
    """Draw the pulls, the learning curve and the map of the final policy, if they exist."""
    run, spec, recorder = training.run, training.spec, training.pulls
    title = f"{spec.algo} on {titled(run.env_name, spec.map_name)}, seed {spec.seed}"
    has_pulls = recorder is not None and recorder.n_calls > 0
    if recorder is not None and has_pulls:
        draw_pulls(run.path / "pulls.png", title, recorder.arrays())
    if not has_pulls or training.evaluation.evaluations_timesteps:
        yardstick = None if final is None else final.yardstick
        first_step, on_variant = training.model._num_timesteps_at_start, training.display.on_variant
        draw_learning_curve(run, title, first_step, yardstick, on_variant=on_variant)
    maps = training.evaluation.value_maps
    if maps is not None and training.evaluation.is_asked_for:
        found = value_map(maps.evaluator, training.model)
        if found is not None:
            draw_value_map(run.value_map_path, title, found)
    if training.evaluation.critics is not None:
        draw_diagnosis(run, title)


# --- the end of a training, also after an error ---------------------------------------------------


@exits_as_mistakes()
def close(training: Training) -> None:
    """Close all open parts; an error in one does not keep the others open."""
    model = training.model
    with ExitStack() as stack:
        if model.env is not None:
            stack.callback(close_environments, model.env)
        stack.callback(close_environments, training.eval_env)
        if hasattr(model, "_logger"):
            stack.callback(model.logger.close)


def give_up(training: Training, error: BaseException) -> None:
    """Record the reason; or remove the folder if the agent failed before its first step."""
    run, is_new = training.run, not training.keeping.goes_on
    if is_gone(run.path):
        raise FolderGoneError(run.path) from error
    is_expected = isinstance(error, ValueError | OSError | KeyboardInterrupt | LibraryError)
    if is_new and is_expected and not has_begun(training):
        run.discard()
        if not isinstance(error, ValueError):  # the other errors explain themselves
            return
        message = f"{training.spec.algo} on {run.env_name}: {one_line(error)}"
        raise UserError(message) from error
    with suppress(OSError):  # the original error says more
        training.evaluation.write()
    if isinstance(error, KeyboardInterrupt) or training.saver.state is not None:
        run.end(state=INTERRUPTED)
        return
    run.fail(one_line(error))
    if isinstance(error, OSError) and error.errno in DISK_ERRORS:
        when = f"the run has failed at step {training.model.num_timesteps:,}"
        raise UserError(f"{error.filename}: {error.strerror}: {when}") from error
