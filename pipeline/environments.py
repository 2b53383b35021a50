"""From a spec to the environments that an agent is trained and evaluated on."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import gymnasium as gym

import envs  # noqa: F401  # registers the project's environments
from envs.wrappers import ActionMasks
from pipeline.errors import UserError, one_line, unknown
from pipeline.train_spec import TrainSpec

# Where neither the environment nor the hyperparameters limit an episode, evaluation does: a greedy
# policy that runs in a circle would never end.
EVALUATION_TIME_LIMIT = 1000

# What environments raise when they are made with wrong arguments.
MISTAKES = (
    TypeError,
    ValueError,
    LookupError,
    AssertionError,
    OSError,
    ImportError,
    gym.error.Error,
)

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]

TRAINING_VEC_ENVS = {"dummy": "DummyVecEnv", "subproc": "SubprocVecEnv"}


def import_gym_packages(packages: tuple[str, ...]) -> None:
    """Import modules for the environments that they register.

    Raises:
        UserError: if one cannot be imported.
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise UserError(f"--gym-packages: cannot import {package}: {error}") from error


def check_env_id(env_id: str) -> None:
    """Make sure that the environment is registered.

    Raises:
        UserError: if it is not; it names the nearest ids.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        import_gym_packages((module,))
    if name not in gym.registry:
        raise unknown("unknown environment", name, gym.registry, n=3)


def make_env(env_id: str, kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """`gym.make`, with mistakes in the arguments put into one line.

    Raises:
        UserError: if the environment cannot be made with these arguments.
    """
    try:
        return gym.make(env_id, **kwargs)
    except MISTAKES as error:
        raise UserError(f"{env_id}: {one_line(error)}") from error


def training_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """Arguments of the environments that the agent is trained on."""
    return {**spec.hyperparams.env_kwargs, **spec.hyperparams.train_env_kwargs}


def evaluation_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """Arguments of the environments that it is evaluated on, which always have a time limit."""
    kwargs = {**spec.hyperparams.env_kwargs, **spec.hyperparams.eval_env_kwargs}
    registered = gym.spec(spec.env_id.rpartition(":")[2]).max_episode_steps
    # Gymnasium takes -1 for no limit at all.
    if kwargs.get("max_episode_steps", registered) in (None, -1):
        kwargs["max_episode_steps"] = EVALUATION_TIME_LIMIT
    return kwargs


def env_wrapper(spec: TrainSpec, training: bool) -> Wrap | None:
    """The wrappers that the hyperparameters name, as one function, or None for none.

    Where the agent is to hold to action masks, the outermost tells them.
    """
    from pipeline.settings.components import wrapper_factory

    inner = wrapper_factory(spec.hyperparams.env_wrapper, spec.gym_packages)
    outer = (
        wrapper_factory(spec.hyperparams.train_env_wrapper, spec.gym_packages, "train_env_wrapper")
        if training
        else None
    )
    wraps = [wrap for wrap in (inner, outer) if wrap is not None]
    if spec.hyperparams.algorithm.get("mask_actions", False):
        wraps.append(_with_masks)
    if not wraps:
        return None
    return lambda env: reduce(lambda wrapped, wrap: wrap(wrapped), wraps, env)


def _with_masks(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    try:
        return ActionMasks(env)
    except ValueError as error:
        raise UserError(f"mask_actions: {one_line(error)}") from error


def make_single_env(spec: TrainSpec, training: bool = False, **extra: Any) -> gym.Env[Any, Any]:
    """One wrapped environment, outside any VecEnv."""
    kwargs = training_kwargs(spec) if training else evaluation_kwargs(spec)
    env = make_env(spec.env_id, {**kwargs, **extra})
    wrap = env_wrapper(spec, training)
    try:
        return env if wrap is None else wrap(env)
    except (TypeError, ValueError, AssertionError) as error:
        raise UserError(f"env_wrapper on {spec.env_id}: {one_line(error)}") from error


def make_training_env(spec: TrainSpec, monitor_folder: Path | None) -> Any:
    """The environments of the training, each under a Monitor that writes into the folder.

    Returns:
        A VecEnv of ``n_envs`` environments.
    """
    return _make_vec_env(spec, spec.hyperparams.n_envs, spec.seed, True, monitor_folder)


def make_evaluation_env(
    spec: TrainSpec, n_envs: int, wrap_innermost: Wrap | None = None, **extra: Any
) -> Any:
    """Environments to evaluate on, without what is meant for training alone.

    Args:
        spec: the run.
        n_envs: how many.
        wrap_innermost: a wrapper to put around each environment before all others.
        extra: further arguments of the environment, such as ``render_mode``.

    Returns:
        A VecEnv.
    """
    return _make_vec_env(spec, n_envs, None, False, None, extra, wrap_innermost)


def _make_vec_env(
    spec: TrainSpec,
    n_envs: int,
    seed: int | None,
    training: bool,
    monitor_folder: Path | None,
    extra: Mapping[str, Any] | None = None,
    wrap_innermost: Wrap | None = None,
) -> Any:
    from stable_baselines3.common import vec_env
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.env_util import make_vec_env

    from pipeline.settings.components import vec_wrapper_factory

    kwargs = training_kwargs(spec) if training else evaluation_kwargs(spec)

    def make(**given: Any) -> gym.Env[Any, Any]:
        env = make_env(spec.env_id, given)
        return env if wrap_innermost is None else wrap_innermost(env)

    env: Any = make_vec_env(
        make,
        n_envs=n_envs,
        seed=seed,
        env_kwargs={**kwargs, **(extra or {})},
        monitor_dir=None if monitor_folder is None else str(monitor_folder),
        monitor_kwargs=spec.hyperparams.monitor_kwargs,
        wrapper_class=env_wrapper(spec, training),
        vec_env_cls=getattr(vec_env, TRAINING_VEC_ENVS[spec.vec_env if training else "dummy"]),
    )
    wrap = vec_wrapper_factory(spec.hyperparams.vec_env_wrapper, spec.gym_packages)
    env = env if wrap is None else wrap(env)
    env = _normalize(env, spec, training)
    if spec.hyperparams.frame_stack is not None:
        env = vec_env.VecFrameStack(env, spec.hyperparams.frame_stack)
    return BaseAlgorithm._wrap_env(env)


def _normalize(env: Any, spec: TrainSpec, training: bool) -> Any:
    """Put VecNormalize around ``env`` where the hyperparameters ask for it."""
    from stable_baselines3.common.vec_env import VecNormalize

    kwargs = spec.hyperparams.normalize
    if kwargs is None:
        return env
    if not training:
        # Statistics come from training, and returns are reported as they are.
        kwargs = {**kwargs, "norm_reward": False, "training": False}
    return VecNormalize(env, **kwargs)
