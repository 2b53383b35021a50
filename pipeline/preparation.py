"""All parts of a training run, made before its first step."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from gymnasium import spaces
from rich.console import Console
from rich.markup import escape
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from agents.common.callback_horizons import EpisodeBudget
from pipeline.callbacks import EpisodeCheckpoint, ExponentialExploration, StepCheckpoint
from pipeline.environments import (
    make_evaluation_env,
    make_single_env,
    make_training_env,
    trains_on_variant,
)
from pipeline.errors import UserError
from pipeline.evaluation.exact import (
    ExactEvaluator,
    exact_evaluator,
    model_refusal,
    why_not_exact,
)
from pipeline.evaluation.sampled import evaluate, evaluation_seed, takes_batches
from pipeline.evaluation.value_maps import ValueMapRecorder
from pipeline.evaluation_callback import EvaluationCallback
from pipeline.memory_limits import check_agent, check_environments, takes_buffers
from pipeline.models.continuation import continuing, load_to_continue, statistics_to_continue
from pipeline.models.model_loading import agent_class
from pipeline.models.model_zips import telling_masks
from pipeline.models.normalization import take_over
from pipeline.number_watch import NumberWatch
from pipeline.progress import ProgressDisplay
from pipeline.pull_recording import PullRecorder, are_bandits
from pipeline.run_folder import Run, environment_name
from pipeline.settings import components
from pipeline.settings.action_noise import action_noise, check_action_noise
from pipeline.settings.algorithm_kwargs import (
    build_algorithm_kwargs,
    default_policy,
    needs_policy,
)
from pipeline.settings.constructor_arguments import algorithm_parameters
from pipeline.signs_of_life import can_move
from pipeline.train_spec import TrainSpec

EVALUATIONS_PER_RUN = 20


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
        pulls: keeps every pull, on bandits; else None, and where a compiled loop was asked for.
        refusal: why the model that the environment brings is not believed; None if it is.
    """

    spec: TrainSpec
    run: Run
    model: BaseAlgorithm
    eval_env: VecEnv
    evaluation: EvaluationCallback
    display: ProgressDisplay
    callback: BaseCallback
    pulls: PullRecorder | None = None
    refusal: str | None = None


def algorithm_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """The arguments of the agent's constructor, checked and made into objects.

    Raises:
        UserError: if one is unknown, has a wrong type or range, or asks for more memory than there
            is.
    """
    algorithm, kwargs = agent_class(spec.algo), spec.hyperparams.algorithm
    check_action_noise(spec.hyperparams, algorithm, spec.algo)
    check_environments(spec.hyperparams.n_envs, spec.algo)
    parameters, observations = algorithm_parameters(algorithm), None
    if needs_policy(algorithm, kwargs) or takes_buffers(spec.hyperparams, parameters):
        env = make_single_env(spec, training=True)
        observations = env.observation_space
        env.close()
    if needs_policy(algorithm, kwargs):
        is_dict = isinstance(observations, spaces.Dict)
        kwargs = {"policy": default_policy(algorithm, is_dict), **kwargs}
    built = build_algorithm_kwargs(algorithm, kwargs, spec.algo, spec.gym_packages)
    defaults = {name: parameter.default for name, parameter in parameters.items()}
    check_agent(spec.hyperparams, {**defaults, **built}, observations, spec.algo)
    return built


def set_up(
    spec: TrainSpec, run: Run, kwargs: dict[str, Any], console: Console, undo: ExitStack
) -> Training:
    """Make all parts of the training, and add to ``undo`` how to remove them again."""
    spec, env = _training_env(spec, run, undo)
    model = _make_model(spec, env, kwargs)
    if is_unread(spec):
        model.set_logger(Logger(folder=None, output_formats=[]))
    n_eval_envs = min(spec.n_eval_envs, spec.eval_episodes) if takes_batches(model) else 1
    eval_env = make_evaluation_env(spec, n_eval_envs)
    undo.callback(eval_env.close)
    is_bandit = are_bandits(env)
    exact = _exact_evaluator(spec, model, console)
    display = ProgressDisplay(console, can_move(console), trains_on_variant(spec))
    evaluation = _evaluation(spec, run, eval_env, env.num_envs, is_bandit, exact, display)
    callbacks = [NumberWatch(), *_named_callbacks(spec, run, model)]
    pulls = _pull_recorder(model, run, console) if is_bandit else None
    if pulls is not None:
        callbacks.append(pulls)
    callbacks.append(evaluation)
    if spec.hyperparams.n_episodes is not None:
        callbacks.append(EpisodeBudget(spec.hyperparams.n_episodes))
    if spec.verbose > 0:
        callbacks.append(display)
    refusal = None if evaluation.value_maps is not None else model_refusal(spec)
    return Training(
        spec, run, model, eval_env, evaluation, display, CallbackList(callbacks), pulls, refusal
    )


def _exact_evaluator(
    spec: TrainSpec, model: BaseAlgorithm, console: Console
) -> ExactEvaluator | None:
    """What computes evaluations where the environment's model is known and the agent lets it."""
    exact = exact_evaluator(spec)
    reason = (
        "" if exact is None else exact.obstacle(model) or why_not_exact(model, exact.observations)
    )
    if reason:
        console.print(f"[dim]evaluations are sampled, not exact: {escape(reason)}[/]")
    return None if reason else exact


def _training_env(spec: TrainSpec, run: Run, undo: ExitStack) -> tuple[TrainSpec, VecEnv]:
    """What the agent is trained on; and the spec, which follows one that goes on."""
    if spec.trained_agent is not None:
        spec = telling_masks(spec, spec.trained_agent)
    statistics = statistics_to_continue(spec)
    if statistics is not None:
        spec = continuing(spec, statistics)
    env = make_training_env(spec, run.path)
    undo.callback(env.close)
    if statistics is not None:
        take_over(env, statistics)
    return spec, env


def _evaluation(
    spec: TrainSpec,
    run: Run,
    eval_env: VecEnv,
    n_envs: int,
    is_bandit: bool,
    exact: ExactEvaluator | None,
    display: ProgressDisplay,
) -> EvaluationCallback:
    """The evaluations during training: exact ones where they can be."""
    seed = evaluation_seed(spec.seed, 1)
    sampled = partial(evaluate, env=eval_env, n_episodes=spec.eval_episodes, seed=seed)
    return EvaluationCallback(
        run,
        eval_env,
        exact or sampled,
        *_evaluation_intervals(spec, n_envs, is_judged_by_regret=exact is None and is_bandit),
        value_maps=None if exact is None else ValueMapRecorder(run.value_maps_path, exact),
        during=display.doing,
    )


def _named_callbacks(spec: TrainSpec, run: Run, model: BaseAlgorithm) -> list[BaseCallback]:
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


def _pull_recorder(model: BaseAlgorithm, run: Run, console: Console) -> PullRecorder | None:
    """What keeps every pull, unless a compiled loop was asked for, which does not stop at each."""
    if getattr(model, "engine", None) == "compiled":
        console.print("[dim]engine: compiled keeps no pulls, so that regret is not known[/]")
        return None
    return PullRecorder(run.path)


def is_unread(spec: TrainSpec) -> bool:
    """Whether nobody reads the library's log, so that its figures need not be worked out."""
    return spec.tensorboard_log is None and spec.verbose < 2


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


def _make_model(spec: TrainSpec, env: VecEnv, kwargs: dict[str, Any]) -> BaseAlgorithm:
    folder = spec.tensorboard_log
    common: dict[str, Any] = {
        "seed": spec.seed,
        "verbose": max(spec.verbose - 1, 0),
        "tensorboard_log": None if folder is None else str(folder / environment_name(spec.env_id)),
        **action_noise(spec.hyperparams, env.action_space),
    }
    if spec.trained_agent is None:
        return _new_model(agent_class(spec.algo), env, spec.device, common, kwargs)
    return load_to_continue(spec, spec.trained_agent, env, **common, **kwargs)


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
