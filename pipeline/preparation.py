"""All parts of a training run, made before its first step."""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import torch as th
from gymnasium import spaces
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from pipeline.callbacks import (
    EvaluationCallback,
    NumberWatch,
    PullRecorder,
    all_callbacks,
    are_bandits,
    evaluation_callback,
    named_callbacks,
    pull_recorder,
)
from pipeline.environments import (
    make_evaluation_env,
    make_single_env,
    make_training_env,
    trains_on_variant,
)
from pipeline.errors import UserError
from pipeline.evaluation.exact import ExactEvaluator, discount_note, evaluator_of, model_refusal
from pipeline.evaluation.policies import why_not_exact
from pipeline.evaluation.sampled import n_environments, takes_batches
from pipeline.evaluation.value_maps import map_refusal
from pipeline.models.choose import (
    continuing,
    load_to_continue,
    model_to_continue,
    statistics_to_continue,
)
from pipeline.models.load import ModelFile, agent_class, take_over, telling_masks
from pipeline.progress import ProgressDisplay
from pipeline.runs import Run, environment_name
from pipeline.settings.components import (
    action_noise,
    build_algorithm_kwargs,
    check_action_noise,
    default_policy,
    needs_policy,
)
from pipeline.settings.values import algorithm_parameters
from pipeline.signs_of_life import can_move
from pipeline.state_saver import StateSaver, resumed_logger
from pipeline.stopping import close_environments, end_workers_after_stop
from pipeline.train_spec import TrainSpec
from pipeline.unfinished_runs import StateKeeping
from pipeline.watching import EvaluationMaps, Watch, watch_of


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
        saver: keeps the state, also part of ``callback``.
        keeping: what becomes of it.
        pulls: keeps every pull, on bandits; else None, and where a compiled loop was asked for.
        refusal: why the model that the environment brings is not believed; None if it is.
        trained_digest: that of the zip that the agent goes on from; None for a new agent.
        watch: keeps how the agent learns, for a page; None where nobody asked for one.
    """

    spec: TrainSpec
    run: Run
    model: BaseAlgorithm
    eval_env: VecEnv
    evaluation: EvaluationCallback
    display: ProgressDisplay
    callback: BaseCallback
    saver: StateSaver
    keeping: StateKeeping
    pulls: PullRecorder | None = None
    refusal: str | None = None
    trained_digest: str | None = None
    watch: Watch | None = None


def algorithm_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """The arguments of the agent's constructor, checked and made into objects.

    Raises:
        UserError: if one is unknown, or has a wrong type or range.
    """
    algorithm, kwargs = agent_class(spec.algo), spec.hyperparams.algorithm
    check_action_noise(spec.hyperparams, algorithm, spec.algo)
    if needs_policy(algorithm, kwargs):
        with closing(make_single_env(spec, training=True)) as env:
            is_dict = isinstance(env.observation_space, spaces.Dict)
        kwargs = {"policy": default_policy(algorithm, is_dict), **kwargs}
    return build_algorithm_kwargs(algorithm, kwargs, spec.algo, spec.gym_packages)


def set_arithmetic(spec: TrainSpec) -> None:
    """What holds for the whole process, and so is set anew for each run in it.

    Raises:
        UserError: if the processor does not know a setting.
    """
    if spec.num_threads > 0:
        th.set_num_threads(spec.num_threads)
    flushes = spec.hyperparams.flush_denormal
    if not th.set_flush_denormal(flushes) and flushes:
        raise UserError("flush_denormal: this processor has no such setting; leave it out")


def set_up(
    spec: TrainSpec,
    run: Run,
    kwargs: dict[str, Any],
    console: Console,
    undo: ExitStack,
    keeping: StateKeeping,
) -> Training:
    """Make all parts of the training, and add to ``undo`` how to remove them again."""
    undo.callback(end_workers_after_stop)
    trained = model_to_continue(spec)
    spec, env = _training_env(spec, trained, run, undo, appends=keeping.state is not None)
    model = make_model(spec, trained, env, kwargs)
    if is_unread(spec):
        model.set_logger(Logger(folder=None, output_formats=[]))
    elif keeping.state is not None:
        model.set_logger(resumed_logger(model, keeping.state.note))
    is_bandit = are_bandits(env)
    exact = _exact_evaluator(spec, model, console)
    gamma = getattr(model, "gamma", None)
    if spec.verbose and exact is not None and isinstance(gamma, float) and not is_bandit:
        note = discount_note(spec, exact, gamma)
        if note is not None:
            _say(console, note)
    eval_env = make_evaluation_env(spec, _n_eval_envs(spec, model, is_exact=exact is not None))
    undo.callback(close_environments, eval_env)
    display = ProgressDisplay(console, can_move(console), trains_on_variant(spec))
    evaluation = evaluation_callback(spec, run, eval_env, env.num_envs, is_bandit, exact, display)
    saver = StateSaver(
        run, keeping.interval, partial(_say, console), keeping.state, keeping.was_cut_off
    )
    saver.modules = spec.user_modules
    pulls = pull_recorder(model, run, console) if is_bandit else None
    # In this order: of a broken number nothing is kept, and no other callback sees a moment that a
    # training goes back from.
    first = [NumberWatch(), saver, *named_callbacks(spec, run, model)]
    watch = _watch(spec, model, exact, evaluation)
    told_steps = None if isinstance(watch, EvaluationMaps) else watch
    others = [*filter(None, [pulls, told_steps]), evaluation]
    saver.root = all_callbacks(spec, [*first, *others], display)
    refusal = None if evaluation.value_maps is not None else model_refusal(spec)
    return Training(
        spec,
        run,
        model,
        eval_env,
        evaluation,
        display,
        saver.root,
        saver,
        keeping,
        pulls,
        refusal,
        None if trained is None else trained.digest,
        watch,
    )


def _watch(
    spec: TrainSpec,
    model: BaseAlgorithm,
    exact: ExactEvaluator | None,
    evaluation: EvaluationCallback,
) -> Watch | None:
    """What keeps how the agent learns; one that looks at evaluations is told of them from now."""
    watch = watch_of(spec, model, exact)
    if isinstance(watch, EvaluationMaps):
        evaluation.callback = watch
    return watch


def _n_eval_envs(spec: TrainSpec, model: BaseAlgorithm, *, is_exact: bool) -> int:
    """How many environments to evaluate on; exact evaluation plays on none."""
    if is_exact or not takes_batches(model):
        return 1
    return n_environments(spec.n_eval_envs, spec.eval_episodes)


def _say(console: Console, line: str) -> None:
    console.print(line, style="dim", markup=False)


def _exact_evaluator(
    spec: TrainSpec, model: BaseAlgorithm, console: Console
) -> ExactEvaluator | None:
    """What computes evaluations where the environment's model is known and the agent lets it."""
    exact = evaluator_of(spec)
    reason = (
        "" if exact is None else exact.obstacle(model) or why_not_exact(model, exact.observations)
    )
    if reason:
        _say(console, f"evaluations are sampled, not exact: {reason}")
    elif exact is not None and (note := map_refusal(exact)) is not None:
        _say(console, note)
    return None if reason else exact


def _training_env(
    spec: TrainSpec, trained: ModelFile | None, run: Run, undo: ExitStack, appends: bool
) -> tuple[TrainSpec, VecEnv]:
    """What the agent is trained on; and the spec, which follows one that goes on.

    With ``appends``, Monitor goes on in the files that are there.
    """
    if trained is not None:
        spec = telling_masks(spec, trained)
    statistics = statistics_to_continue(spec)
    if statistics is not None:
        spec = continuing(spec, statistics)
    env = make_training_env(appending(spec) if appends else spec, run.path)
    undo.callback(close_environments, env)
    if statistics is not None:
        take_over(env, statistics)
    return spec, env


def appending(spec: TrainSpec) -> TrainSpec:
    """The spec, with Monitors that go on in the files that are there."""
    hyperparams = spec.hyperparams
    arguments = {**hyperparams.monitor_kwargs, "override_existing": False}
    return replace(spec, hyperparams=replace(hyperparams, monitor_kwargs=arguments))


def is_unread(spec: TrainSpec) -> bool:
    """Whether nobody reads the library's log, so that its figures need not be worked out."""
    return spec.tensorboard_log is None and spec.verbose < 2


def make_model(
    spec: TrainSpec, trained: ModelFile | None, env: VecEnv, kwargs: dict[str, Any]
) -> BaseAlgorithm:
    """The agent of a run, a new one or the one that it goes on from.

    Args:
        spec: the run.
        trained: the file of an agent that goes on; None for a new one.
        env: the environments of the training.
        kwargs: the constructor's arguments, see `algorithm_kwargs`.
    """
    folder = spec.tensorboard_log
    common: dict[str, Any] = {
        "seed": spec.seed,
        "verbose": max(spec.verbose - 1, 0),
        "tensorboard_log": None if folder is None else str(folder / environment_name(spec.env_id)),
        **action_noise(spec.hyperparams, env.action_space),
    }
    if trained is None:
        return _new_model(agent_class(spec.algo), env, spec.device, common, kwargs)
    return load_to_continue(spec, trained, env, **common, **kwargs)


def _new_model(
    algorithm: type[BaseAlgorithm],
    env: VecEnv,
    device: str,
    common: dict[str, Any],
    kwargs: dict[str, Any],
) -> BaseAlgorithm:
    """An agent; what its constructor does not take of the common arguments is set afterwards."""
    given, parameters = {"device": device, **common}, algorithm_parameters(algorithm)
    taken = {name: value for name, value in given.items() if name in parameters}
    if "seed" not in taken:
        set_random_seed(common["seed"])
    # The type checker knows the arguments of the base class, which has more of them.
    model: BaseAlgorithm = cast(Any, algorithm)(env=env, **taken, **kwargs)
    for name in common.keys() - taken.keys():
        setattr(model, name, common[name])
    if "seed" not in taken:
        model.set_random_seed(common["seed"])
    return model
