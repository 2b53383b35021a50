"""Makes the training and evaluation environments of a spec."""

from __future__ import annotations

import inspect
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import reduce
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.envs.bandits.logged import ReplayBandit
from rl_yardstick.envs.grid import GridWorld, read_rows
from rl_yardstick.envs.wrappers import ActionMasks, has_masks
from rl_yardstick.pipeline.errors import UserError, one_line, shown, unknown
from rl_yardstick.pipeline.stopping import shield_workers
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.user_modules import import_again
from rl_yardstick.safe_files.files import memory_bytes

# The time limit of evaluations if neither environment nor hyperparameters set one: a greedy policy
# that moves in a circle would never end an episode.
EVALUATION_TIME_LIMIT = 1000

# Exceptions that environments raise for wrong arguments.
_OF_ARGUMENTS = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError)
MISTAKES = (*_OF_ARGUMENTS, AssertionError, OSError, ImportError, MemoryError, gym.error.Error)

_BYTES_PER_ENVIRONMENT = 20_000  # CartPole with its Monitor takes more

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]

TRAINING_VEC_ENVS = {"dummy": "DummyVecEnv", "subproc": "SubprocVecEnv"}


def check_memory(what: str, n_bytes: int, where: str) -> None:
    """Refuse settings that need more memory than this machine has."""
    if n_bytes > memory_bytes():
        needed, present = (f"{max(round(n / 2**30), 1):,} GB" for n in (n_bytes, memory_bytes()))
        raise UserError(
            f"{where}: {what} would take {needed} of memory at least, "
            f"and this machine has {present}"
        )


def check_env_id(env_id: str) -> None:
    """Check that the environment is registered, without importing a module."""
    module, _, name = env_id.rpartition(":")
    if module and module not in sys.modules:
        raise UserError(
            f"{shown(env_id)}: its module is not imported because a file asks: "
            f"add --gym-packages {shlex.quote(module)}"
        )
    if name not in gym.registry:
        raise unknown("unknown environment", name, gym.registry, n=3)


def make_env(env_id: str, kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """`gym.make` with errors in one line; does not import the module of ``module:Env-v0``."""
    try:
        return gym.make(env_id.rpartition(":")[2], **kwargs)
    except MISTAKES as error:
        raise environment_mistake(env_id, kwargs, error) from error


def training_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """Arguments of the training environments."""
    return {**spec.hyperparams.env_kwargs, **spec.hyperparams.train_env_kwargs}


def evaluation_kwargs(spec: TrainSpec) -> dict[str, Any]:
    """Arguments of the evaluation environments, which always have a time limit."""
    kwargs = {**spec.hyperparams.env_kwargs, **spec.hyperparams.eval_env_kwargs}
    registered = gym.spec(spec.env_id.rpartition(":")[2]).max_episode_steps
    # For Gymnasium, -1 means no limit.
    if kwargs.get("max_episode_steps", registered) in (None, -1):
        kwargs["max_episode_steps"] = EVALUATION_TIME_LIMIT
    return kwargs


def training_changes(spec: TrainSpec) -> tuple[str, ...]:
    """How training's environment differs from the one of evaluations, in words; often empty.

    The returns of a training with changes are not compared with the optimum.
    """
    special, told = spec.hyperparams, []
    usual = {**usual_kwargs(spec.env_id), **special.env_kwargs}
    training, evaluation = special.train_env_kwargs, special.eval_env_kwargs
    for key in {**training, **evaluation}:
        if key == "max_episode_steps" and key not in training:
            continue  # evaluations need a limit where the environment has none
        value, other = (kwargs.get(key, usual.get(key)) for kwargs in (training, evaluation))
        if key == "max_episode_steps":  # for Gymnasium, -1 means no limit
            value, other = (None if limit == -1 else limit for limit in (value, other))
            words = f"episodes of {value} steps" if value else "no time limit"
        else:
            words = "random starts" if (key, value) == ("random_start", True) else f"{key} {value}"
        if value != other:
            told.append(words)
    for wrapper in special.train_env_wrapper:
        given = (wrapper.kwargs.get(key) for key in ("min_reward", "max_reward"))
        bounds = [f"{bound:g}" for bound in given if bound is not None]
        name = wrapper.name.rpartition(".")[2]
        if name == "ScaleReward" and "scale" in wrapper.kwargs:
            told.append(f"rewards x {wrapper.kwargs['scale']:g}")
        elif name == "ClipReward" and bounds:
            told.append(f"rewards clipped at {' and '.join(bounds)}")
        else:
            told.append(name)
    return tuple(told)


def usual_kwargs(env_id: str) -> dict[str, Any]:
    """The default arguments of an environment, as far as they are known."""
    registered, make = gym.spec(env_id.rpartition(":")[2]), _creator(env_id)
    parameters = {} if make is None else inspect.signature(make).parameters
    defaults = {p.name: p.default for p in parameters.values() if p.default is not p.empty}
    return {**defaults, **registered.kwargs, "max_episode_steps": registered.max_episode_steps}


def env_wrapper(spec: TrainSpec, training: bool, folder: Path | None = None) -> Wrap | None:
    """One function for all wrappers, with masks outermost for agents that need them; or None."""
    from rl_yardstick.pipeline.settings.components import wrapper_factory

    named = {"env_wrapper": spec.hyperparams.env_wrapper}
    if training:
        named["train_env_wrapper"] = spec.hyperparams.train_env_wrapper
    made = (wrapper_factory(w, spec.gym_packages, key, folder) for key, w in named.items())
    wraps = [wrap for wrap in made if wrap is not None]
    if spec.hyperparams.algorithm.get("mask_actions", False):

        def with_masks(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
            try:
                return ActionMasks(env)
            except ValueError as error:
                raise UserError(f"mask_actions: {one_line(error)}") from error

        wraps.append(with_masks)
    elif spec.algo in ALGORITHMS and ALGORITHMS[spec.algo].needs_masks:
        # Without masks, `check_fit` raises the error, which names fitting agents.
        wraps.append(lambda env: ActionMasks(env) if has_masks(env) else env)
    if not wraps:
        return None
    return lambda env: reduce(lambda wrapped, wrap: wrap(wrapped), wraps, env)


def make_single_env(spec: TrainSpec, training: bool = False, **extra: Any) -> gym.Env[Any, Any]:
    """Make one wrapped environment, outside any VecEnv."""
    kwargs = training_kwargs(spec) if training else evaluation_kwargs(spec)
    env = make_env(spec.env_id, {**kwargs, **extra})
    wrap = env_wrapper(spec, training)
    try:
        return env if wrap is None else wrap(env)
    except (TypeError, ValueError, AssertionError) as error:
        raise UserError(f"env_wrapper on {spec.env_id}: {one_line(error)}") from error


def make_training_env(spec: TrainSpec, monitor_folder: Path | None) -> Any:
    """Make the training environments, each in a Monitor that writes into the folder."""
    return _make_vec_env(spec, spec.hyperparams.n_envs, first_slot_seed(spec), True, monitor_folder)


def first_slot_seed(spec: TrainSpec) -> int:
    """The seed of the first training environment; each next environment adds 1.

    Two runs with different seeds and equally many environments share no seed.
    """
    return spec.seed * spec.hyperparams.n_envs


def make_evaluation_env(
    spec: TrainSpec,
    n_envs: int,
    wrap_innermost: Wrap | None = None,
    monitor_folder: Path | None = None,
    **extra: Any,
) -> Any:
    """Make the evaluation VecEnv; ``extra`` are further arguments of the environments."""
    return _make_vec_env(spec, n_envs, None, False, monitor_folder, extra, wrap_innermost)


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

    from rl_yardstick.pipeline.settings.components import vec_wrapper_factory

    check_memory(f"n_envs {n_envs:,}", n_envs * _BYTES_PER_ENVIRONMENT, spec.env_id)
    kwargs = training_kwargs(spec) if training else evaluation_kwargs(spec)
    if training and spec.vec_env == "subproc":
        shield_workers()

    def make(**given: Any) -> gym.Env[Any, Any]:
        import_again(spec.user_modules)  # this may run in another process
        env = make_env(spec.env_id, given)
        return env if wrap_innermost is None else wrap_innermost(env)

    def wrap_elsewhere(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        wrap = env_wrapper(spec, training, monitor_folder)  # after the import of its classes
        return env if wrap is None else wrap(env)

    wrapper = env_wrapper(spec, training, monitor_folder)
    env: Any = make_vec_env(
        make,
        n_envs=n_envs,
        seed=seed,
        env_kwargs={**kwargs, **(extra or {})},
        monitor_dir=None if monitor_folder is None else str(monitor_folder),
        monitor_kwargs=spec.hyperparams.monitor_kwargs,
        wrapper_class=wrap_elsewhere if spec.vec_env == "subproc" else wrapper,
        vec_env_cls=getattr(vec_env, TRAINING_VEC_ENVS[spec.vec_env if training else "dummy"]),
    )
    with ExitStack() as undo:  # closes the environments if wrapping fails
        undo.callback(env.close)
        wrappers = spec.hyperparams.vec_env_wrapper
        wrap = vec_wrapper_factory(wrappers, spec.gym_packages, folder=monitor_folder)
        env = env if wrap is None else wrap(env)
        if (normalize := spec.hyperparams.normalize) is not None:
            # Statistics come from training, and evaluation reports unnormalised returns.
            fixed = {} if training else {"norm_reward": False, "training": False}
            env = vec_env.VecNormalize(env, **{**normalize, **fixed})
        if spec.hyperparams.frame_stack is not None:
            env = vec_env.VecFrameStack(env, spec.hyperparams.frame_stack)
        env = BaseAlgorithm._wrap_env(env)
        undo.pop_all()
    return env


# Arguments that `gymnasium.make` uses itself.
_OF_MAKE = ("max_episode_steps", "render_mode")
# Gymnasium adds this to some errors, followed by all arguments.
_ADDED = " was raised from the environment creator"


def environment_mistake(env_id: str, kwargs: Mapping[str, Any], error: Exception) -> UserError:
    """The one-line message for an ``error`` from making an environment with ``kwargs``."""
    parameters: Mapping[str, inspect.Parameter] = {}
    creator: Any = None
    with suppress(ImportError, AttributeError, TypeError, ValueError):
        creator = _creator(env_id)
        parameters = inspect.signature(creator).parameters
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    foreign = next((name for name in kwargs if name not in (*parameters, *_OF_MAKE)), None)
    if foreign is not None and parameters and not takes_any:
        known = [name for name in (*parameters, *_OF_MAKE) if name != "render_mode"]
        return unknown(f"{env_id}: unknown argument", foreign, known)
    if isinstance(error, KeyError):
        # A failed look-up, mostly of an argument.
        key = error.args[0] if error.args else None
        name = next((name for name, value in kwargs.items() if value is key or value == key), None)
        if name is None:
            return UserError(f"{env_id}: it looks up {shown(key)}, which does not exist")
        # The known values are the keys of a table in its module that contains the default.
        default = parameters[name].default if name in parameters else None
        module = sys.modules.get(getattr(creator, "__module__", ""), object)
        tables = (table for table in vars(module).values() if isinstance(table, dict))
        known = next(([*t] for t in tables if isinstance(default, str) and default in t), [])
        return unknown(f"{env_id}: unknown {name}", str(key), map(str, known))
    what = one_line(error).partition(_ADDED)[0]
    if kwargs and not any(name in what for name in kwargs):
        what += f" (with {', '.join(f'{name}={shown(value)}' for name, value in kwargs.items())})"
    return UserError(f"{env_id}: {what}")


@contextmanager
def lacking_packages_told(env_id: str) -> Iterator[None]:
    """Turn the error for a missing package into one line; it may appear only at rendering."""
    try:
        yield
    except gym.error.DependencyNotInstalled as error:
        raise UserError(f"{env_id}: {one_line(error)}") from error


def _creator(env_id: str) -> Any:
    """The class or function that creates the environment."""
    entry_point = gym.spec(env_id.rpartition(":")[2]).entry_point
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


_ENV_KWARGS = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")


def with_maps_read(env_id: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The hyperparameters with the rows of each grid world map in place of its file path."""
    named = _naming(settings, "desc", env_id, GridWorld)
    try:
        read = {
            key: {**settings[key], "desc": list(read_rows(settings[key]["desc"]))} for key in named
        }
    except ValueError as error:
        raise UserError(f"{env_id}: {one_line(error)}") from error
    return {**settings, **read}


def map_name(env_id: str, settings: Mapping[str, Any]) -> str:
    """The file name of the grid world map that is evaluated on; empty if it is in no file."""
    parts = [settings.get(key) for key in ("eval_env_kwargs", "env_kwargs")]
    given = [part["desc"] for part in parts if isinstance(part, dict) and "desc" in part]
    if not given or not isinstance(given[0], str) or "\n" in given[0]:
        return ""
    is_map = _naming({"env_kwargs": {"desc": given[0]}}, "desc", env_id, GridWorld)
    return Path(given[0]).name if is_map else ""


def titled(environment: str, map_name: str) -> str:
    """The name of an environment for titles, with the file of its map."""
    return f"{environment} ({map_name})" if map_name else environment


def with_logs_located(env_id: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The hyperparameters with absolute paths of the logs of a ReplayBandit."""
    named = _naming(settings, "log", env_id, ReplayBandit)
    paths = {key: str(Path(settings[key]["log"]).absolute()) for key in named}
    return {**settings, **{key: {**settings[key], "log": path} for key, path in paths.items()}}


def _naming(
    settings: Mapping[str, Any], argument: str, env_id: str, kind: type[gym.Env[Any, Any]]
) -> list[str]:
    """The keys with a text for this argument; empty if the environment is not of this kind."""
    given = {key: settings.get(key) for key in _ENV_KWARGS}
    named = [
        key
        for key, env_kwargs in given.items()
        if isinstance(env_kwargs, dict) and isinstance(env_kwargs.get(argument), str)
    ]
    creator = _creator(env_id) if named else None
    return named if isinstance(creator, type) and issubclass(creator, kind) else []
