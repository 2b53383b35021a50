"""`prepare` makes the run folder and all parts of a training before its first step."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast
from uuid import uuid4

import torch as th
from gymnasium import spaces
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.agents.compiled.env_states import observed_world
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.callbacks import (
    EvaluationCallback,
    NumberWatch,
    PullRecorder,
    evaluation_intervals,
    named_callbacks,
)
from rl_yardstick.pipeline.digests import VERSION, VERSION_FIELD
from rl_yardstick.pipeline.environments import (
    first_slot_seed,
    make_evaluation_env,
    make_single_env,
    make_training_env,
    training_changes,
)
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.critics import CriticRecorder, recorder_of
from rl_yardstick.pipeline.evaluation.exact import (
    ExactEvaluator,
    discount_note,
    evaluator_of,
    model_refusal,
)
from rl_yardstick.pipeline.evaluation.histories import (
    BY_HISTORIES,
    HistoryEvaluator,
    world_of_memory,
)
from rl_yardstick.pipeline.evaluation.policies import has_memory, why_not_exact
from rl_yardstick.pipeline.evaluation.sampled import SampledEvaluator, n_environments, takes_batches
from rl_yardstick.pipeline.evaluation.value_maps import ValueMapRecorder, map_refusal
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.files import naming
from rl_yardstick.pipeline.loaded_code import recorded_code
from rl_yardstick.pipeline.models.choose import (
    continuing,
    load_to_continue,
    model_to_continue,
    statistics_to_continue,
)
from rl_yardstick.pipeline.models.load import ModelFile, agent_class, take_over, telling_masks
from rl_yardstick.pipeline.progress import ProgressDisplay
from rl_yardstick.pipeline.runs import (
    RUNNING,
    TRAINED_AGENT,
    Run,
    environment_name,
    recorded_machine,
    recorded_versions,
    remove_leftovers,
    write_arguments,
    write_settings,
)
from rl_yardstick.pipeline.settings import components
from rl_yardstick.pipeline.settings.components import (
    action_noise,
    build_algorithm_kwargs,
    check_action_noise,
    default_policy,
    needs_policy,
)
from rl_yardstick.pipeline.settings.values import algorithm_parameters
from rl_yardstick.pipeline.signs_of_life import can_move, in_lines
from rl_yardstick.pipeline.state_saver import StateSaver, resumed_logger
from rl_yardstick.pipeline.stopping import close_environments, current, end_workers_after_stop
from rl_yardstick.pipeline.train_spec import NETWORKS, TrainSpec
from rl_yardstick.pipeline.unfinished_runs import StateKeeping
from rl_yardstick.pipeline.watching import EvaluationMaps, Watch, watch_of

if TYPE_CHECKING:
    from rl_yardstick.agents.networks.engine_setting import EnginePlan, Work

# The number of steps for a budget in episodes; never reached.
UNBOUNDED_TIMESTEPS = 10**12
NEW = StateKeeping()


@dataclass(frozen=True)
class Training:
    """A run that is set up and can be started."""

    spec: TrainSpec  # including settings of an agent that continues
    run: Run
    model: BaseAlgorithm  # the agent, with its environments
    eval_env: VecEnv
    display: ProgressDisplay
    callback: BaseCallback  # all callbacks
    evaluation: EvaluationCallback  # one of them
    saver: StateSaver  # likewise
    keeping: StateKeeping
    pulls: PullRecorder | None  # on bandits, unless a compiled loop was requested
    watch: Watch | None  # records how the agent learns, for a page
    refusal: str | None  # why the environment's own model is rejected


@exits_as_mistakes()
def prepare(
    spec: TrainSpec,
    console: Console,
    args: dict[str, Any],
    command: str,
    run: Run | None = None,
    keeping: StateKeeping = NEW,
) -> Training:
    """Make all parts of the training, and the run folder unless ``run`` is given.

    Writes ``args`` and ``command`` to the folder; ``keeping`` decides about saved states. Raises
    UserError if the spec is invalid or the environment asks the program to end, and `Stopped` on
    a signal; then no folder stays behind.
    """
    if spec.num_threads > 0:
        th.set_num_threads(spec.num_threads)
    flushes = spec.hyperparams.flush_denormal
    if not th.set_flush_denormal(flushes) and flushes:
        raise UserError("flush_denormal: this processor has no such setting; leave it out")
    stop = current()
    with stop.waiting(0.0):
        kwargs = algorithm_kwargs(spec)
        if run is None:
            remove_leftovers(spec.log_folder, spec.algo, spec.env_id)
    with stop.held(), ExitStack() as undo, _library_errors_in_one_line():
        if run is None:
            suffix = f"_{uuid4()}" if spec.unique_id else ""
            run = Run.claim(spec.log_folder, spec.algo, spec.env_id, suffix)
        if not keeping.goes_on:
            undo.callback(run.discard)
        with stop.waiting(0.0), naming(run.path):
            run.keep_room()
            trained = model_to_continue(spec)
            training = _set_up(spec, trained, run, kwargs, console, undo, keeping)
            load_for_optimizer(training.model)
        if keeping.goes_on:
            run.reopen()
        else:
            _record_beginning(training, trained, args, command)
            stop.raise_if_asked()
        undo.pop_all()
    return training


@contextmanager
def _library_errors_in_one_line() -> Iterator[None]:
    """Turn the library's errors about settings into errors of one line."""
    try:
        yield
    except (ValueError, TypeError, AssertionError, RuntimeError, MemoryError) as error:
        raise UserError(one_line(error)) from error


def load_for_optimizer(model: Any) -> None:
    """Import PyTorch's compiler, as optimizers do at their first step; takes over a second."""
    has_optimizer = getattr(getattr(model, "policy", None), "optimizer", None) is not None
    if has_optimizer and getattr(model, "engine", "library") == "library":
        with loading_libraries():
            import torch._dynamo  # noqa: F401


def algorithm_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """Check the arguments of the agent's constructor, and build their objects."""
    algorithm, kwargs = agent_class(spec.algo), spec.hyperparams.algorithm
    check_action_noise(spec.hyperparams, algorithm, spec.algo)
    if needs_policy(algorithm, kwargs):
        with closing(make_single_env(spec, training=True)) as env:
            is_dict = isinstance(env.observation_space, spaces.Dict)
        kwargs = {"policy": default_policy(algorithm, is_dict), **kwargs}
    return build_algorithm_kwargs(algorithm, kwargs, spec.algo, spec.gym_packages)


def _set_up(
    spec: TrainSpec,
    trained: ModelFile | None,
    run: Run,
    kwargs: dict[str, Any],
    console: Console,
    undo: ExitStack,
    keeping: StateKeeping,
) -> Training:
    """Make all parts of the training, and register their removal in ``undo``."""
    undo.callback(end_workers_after_stop)
    spec, env = _training_env(spec, trained, run, undo, appends=keeping.state is not None)
    model = make_model(spec, trained, env, kwargs)
    if is_unread(spec):
        model.set_logger(Logger(folder=None, output_formats=[]))
    elif keeping.state is not None:
        model.set_logger(resumed_logger(model, keeping.state.note))
    is_bandit = env.has_attr("n_arms")
    exact, yardstick = _exact_evaluator(spec, model, console)
    world = None if exact is not None else world_of_memory(spec, model)
    if world is not None:
        _say(console, BY_HISTORIES)
    n_eval_envs = 1
    if exact is None and takes_batches(model):
        n_eval_envs = n_environments(spec.n_eval_envs, spec.eval_episodes)
    eval_env = make_evaluation_env(spec, n_eval_envs)
    undo.callback(close_environments, eval_env)
    display = ProgressDisplay(console, can_move(console), bool(training_changes(spec)))
    intervals = evaluation_intervals(spec, env.num_envs, is_bandit and exact is None)
    critics = _critics(spec, model, run, console, is_evaluated=max(intervals) > 0)
    evaluation = EvaluationCallback(
        run,
        eval_env,
        exact
        or (HistoryEvaluator(spec, eval_env, world) if world is not None else None)
        or SampledEvaluator(spec, eval_env, yardstick),
        *intervals,
        value_maps=None if exact is None else ValueMapRecorder(run.value_maps_path, exact),
        critics=critics,
        during=display.doing,
    )
    saver = StateSaver(run, keeping, partial(_say, console), spec.user_modules)
    pulls = None
    if is_bandit and getattr(model, "engine", None) == "compiled":  # it does not stop at pulls
        _say(console, "engine: compiled keeps no pulls, so that regret is not known")
    elif is_bandit:
        pulls = PullRecorder(run.path)
    watch = watch_of(spec, model, exact)
    shows_evaluations = isinstance(watch, EvaluationMaps)
    if shows_evaluations:
        evaluation.callback = watch
    # In this order: numbers are checked before anything is stored, and a saved state is restored
    # before any other callback acts.
    first = [NumberWatch(), saver, *named_callbacks(spec, run, model)]
    others = [*filter(None, [pulls, critics, None if shows_evaluations else watch]), evaluation]
    if spec.hyperparams.n_episodes is not None:
        others.append(EpisodeBudget(spec.hyperparams.n_episodes))
    if spec.verbose > 0:
        others.append(display)
    saver.root = CallbackList([*first, *others])
    return Training(
        spec,
        run,
        model,
        eval_env,
        display,
        saver.root,
        evaluation,
        saver,
        keeping,
        pulls,
        watch,
        refusal=None if evaluation.value_maps is not None else model_refusal(spec),
    )


def _record_beginning(
    training: Training, trained: ModelFile | None, args: dict[str, Any], command: str
) -> None:
    run, spec = training.run, training.spec
    write_settings(run, spec, command)
    write_arguments(run, spec, args)
    run.update_info(
        state=RUNNING,
        **{VERSION_FIELD: VERSION},
        env_name=run.env_name,
        spec=spec.as_data(),
        versions=recorded_versions(),
        machine=recorded_machine(),
        **recorded_code(spec.user_modules),
        **({} if trained is None else {TRAINED_AGENT: trained.digest}),
        **({} if training.refusal is None else {"model_refused": training.refusal}),
    )


def _say(console: Console, line: str) -> None:
    console.print(in_lines(console, line), style="dim", markup=False)


def _exact_evaluator(
    spec: TrainSpec, model: BaseAlgorithm, console: Console
) -> tuple[ExactEvaluator | None, Yardstick | None]:
    """Make the exact evaluator, if the environment's model is known and the agent permits it.

    If `obstacle` or `why_not_exact` prevents it, return None and the yardstick.
    """
    exact = None if has_memory(model) else evaluator_of(spec)
    if exact is None:
        return None, None
    obstacle = exact.obstacle(model)
    if reason := obstacle or why_not_exact(model, exact.observations):
        _say(console, f"evaluations are sampled, not exact: {reason}")
        # A user's agent that cannot be queried in all states may have memory.
        if exact.scale is not None and not obstacle:
            return None, exact.scale.yardstick(with_memory=True)
        return None, exact.yardstick
    notes = [map_refusal(exact)]
    if exact.scale is not None and spec.verbose:
        notes.append(exact.scale.note)
    gamma = getattr(model, "gamma", None)
    is_bandit = model.env is not None and model.env.has_attr("n_arms")
    if spec.verbose and isinstance(gamma, float) and not is_bandit:
        notes.append(discount_note(spec, exact, gamma))
    for note in filter(None, notes):
        _say(console, note)
    return exact, None


def _critics(
    spec: TrainSpec, model: BaseAlgorithm, run: Run, console: Console, *, is_evaluated: bool
) -> CriticRecorder | None:
    """Make the recorder of ``--diagnose``, or print why there is none."""
    if not spec.diagnose:
        return None
    found = recorder_of(run.diagnosis_path, spec, model, is_evaluated=is_evaluated)
    if isinstance(found, CriticRecorder):
        return found
    _say(console, f"no diagnosis: {found}")
    return None


def _training_env(
    spec: TrainSpec, trained: ModelFile | None, run: Run, undo: ExitStack, appends: bool
) -> tuple[TrainSpec, VecEnv]:
    """Make the training environments, and the spec with settings of an agent that continues."""
    if trained is not None:
        spec = telling_masks(spec, trained)
    statistics = statistics_to_continue(spec)
    if statistics is not None:
        spec = continuing(spec, statistics)
    made = spec
    if appends:  # Monitor appends to the existing files
        monitor_kwargs = {**spec.hyperparams.monitor_kwargs, "override_existing": False}
        made = replace(spec, hyperparams=replace(spec.hyperparams, monitor_kwargs=monitor_kwargs))
    env = make_training_env(made, run.path)
    undo.callback(close_environments, env)
    if statistics is not None:
        take_over(env, statistics)
    return spec, env


def is_unread(spec: TrainSpec) -> bool:
    """Whether the library's log has no reader, so that it need not be computed."""
    return spec.tensorboard_log is None and spec.verbose < 2


def make_model(
    spec: TrainSpec, trained: ModelFile | None, env: VecEnv, kwargs: dict[str, Any]
) -> BaseAlgorithm:
    """Make or load the agent of a run, and seed its environments."""
    model = _model(spec, trained, env, kwargs)
    # The library seeds slot i with s + i, so consecutive seeds would share most random streams.
    env.seed(first_slot_seed(spec))
    return model


def _model(
    spec: TrainSpec, trained: ModelFile | None, env: VecEnv, kwargs: dict[str, Any]
) -> BaseAlgorithm:
    folder = spec.tensorboard_log
    common: dict[str, Any] = {
        "seed": spec.seed,
        "verbose": max(spec.verbose - 1, 0),
        "tensorboard_log": None if folder is None else str(folder / environment_name(spec.env_id)),
        **action_noise(spec.hyperparams, env.action_space),
    }
    if trained is not None:
        return load_to_continue(spec, trained, env, **common, **kwargs)
    # Arguments that the constructor does not accept are set afterwards.
    algorithm, given = agent_class(spec.algo), {"device": spec.device, **common}
    parameters = algorithm_parameters(algorithm)
    taken = {name: value for name, value in given.items() if name in parameters}
    if "seed" not in taken:
        set_random_seed(spec.seed)
    # For the type checker: the base class has other arguments.
    model: BaseAlgorithm = cast(Any, algorithm)(env=env, **taken, **kwargs)
    for name in common.keys() - taken.keys():
        setattr(model, name, common[name])
    if "seed" not in taken:
        model.set_random_seed(common["seed"])
    return model


# --- the engine of networks, determined before a training begins ----------------------------------


@dataclass(frozen=True)
class EngineOutlook:
    """The engine of a training, and its alternative."""

    plan: EnginePlan  # the engine of the training
    auto: EnginePlan  # the choice of ``engine: auto``
    work: Work | None  # None if the time of an environment step is unknown


def engine_outlook(
    model: BaseAlgorithm, spec: TrainSpec, callbacks: list[BaseCallback]
) -> EngineOutlook | None:
    """The outlook of an agent; None if it has no compiled networks."""
    from rl_yardstick.agents.networks.engine_setting import CompiledNetworks  # slow import

    if not isinstance(model, CompiledNetworks) or model.env is None:
        return None
    n_timesteps = spec.hyperparams.n_timesteps or UNBOUNDED_TIMESTEPS
    plan = model.engine_plan(n_timesteps, callbacks)
    auto = model.engine_plan(n_timesteps, callbacks, "auto")
    work = None
    with suppress(NotCompilable):
        observed_world(model.env)
        work = model.work(n_timesteps, callbacks)
    return EngineOutlook(plan, auto, work)


def planned_outlook(spec: TrainSpec) -> EngineOutlook | None:
    """The outlook of a run in another process, which reports any errors itself."""
    if spec.algo not in NETWORKS:
        return None
    with (
        suppress(Exception),
        warnings.catch_warnings(action="ignore"),
        closing(make_training_env(spec, None)) as env,
    ):
        model = make_model(spec, None, env, algorithm_kwargs(spec))
        special, modules = spec.hyperparams, spec.gym_packages
        callbacks = components.callbacks(special.callback, modules, spec.log_folder)
        if special.n_episodes is not None:
            callbacks.append(EpisodeBudget(special.n_episodes))
        return engine_outlook(model, spec, callbacks)
    return None
