"""Environments of a spec: one, for its model; or a VecEnv, for training and for evaluations."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

from rl_yardstick.agents.registry import ALGORITHMS, fitting_algorithms, is_bandit
from rl_yardstick.envs import wrappers  # and registers this project's environments
from rl_yardstick.envs.bandits.logged import ReplayBandit
from rl_yardstick.envs.grid import GridWorld, read_rows
from rl_yardstick.pipeline.components import build, import_modules, split_id
from rl_yardstick.pipeline.errors import UserError, as_user_error, one_line, shown, unknown
from rl_yardstick.pipeline.spec import TrainSpec

# The time limit of evaluations if neither environment nor settings have one: a greedy policy that
# moves in a circle would never end an episode.
EVALUATION_TIME_LIMIT = 1000
MOST_BOXES = 1_000_000  # of a vector cut into bins
MISTAKES = (
    *(TypeError, ValueError, LookupError, AttributeError, ArithmeticError, AssertionError),
    *(OSError, ImportError, MemoryError, gym.error.Error),
)

Env = gym.Env[Any, Any]


def check_env_id(env_id: str) -> None:
    """Raise UserError if no such environment is registered."""
    module, name = split_id(env_id)
    if module:
        raise UserError(f"{env_id}: name it {name}, and add --gym-packages {module}")
    if env_id not in gym.registry and ("ALE/" in env_id or "NoFrameskip" in env_id):
        raise UserError(f"{env_id}: pip install ale-py, and add --gym-packages ale_py")
    if env_id not in gym.registry:
        raise unknown("unknown environment", env_id, gym.registry, n=3)


def make_env(env_id: str, kwargs: Mapping[str, Any]) -> Env:
    """`gymnasium.make` with mistakes in one line."""
    check_env_id(env_id)
    try:
        return gym.make(env_id, **kwargs)
    except MISTAKES as error:
        parameters = _parameters(env_id)
        kwargs = {key: value for key, value in kwargs.items() if key != "disable_env_checker"}
        known = [*parameters, "max_episode_steps", "render_mode"]  # of `gymnasium.make` itself
        foreign = [name for name in kwargs if name not in known]
        takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        if foreign and parameters and not takes_any:
            raise unknown(f"{env_id}: unknown argument", foreign[0], known) from error
        # Gymnasium adds all arguments to some errors.
        what = one_line(error).partition(" was raised from the environment creator")[0]
        what = f"there is no {what}" if isinstance(error, KeyError) else what
        if kwargs and not any(name in what for name in kwargs):
            what += f" (with {', '.join(f'{name}={shown(kwargs[name])}' for name in kwargs)})"
        raise UserError(f"{env_id}: {what}") from error


def _parameters(env_id: str) -> Mapping[str, inspect.Parameter]:
    with suppress(ImportError, AttributeError, TypeError, ValueError, gym.error.Error):
        return inspect.signature(creator_of(env_id)).parameters
    return {}


def creator_of(env_id: str) -> Any:
    """The class or function that makes an environment."""
    entry_point = gym.spec(env_id).entry_point
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


# --- training and evaluation: their arguments and wrappers ----------------------------------------


def kwargs_of(spec: TrainSpec, training: bool = False) -> dict[str, Any]:
    """Arguments of training's environments, or of evaluations', whose episodes always end."""
    if training:
        return {**spec.env_kwargs, **spec.train_env_kwargs}
    kwargs = {**spec.env_kwargs, **spec.eval_env_kwargs}
    registered = gym.spec(spec.env_id).max_episode_steps
    if kwargs.get("max_episode_steps", registered) in (None, -1):  # -1: no limit
        kwargs["max_episode_steps"] = EVALUATION_TIME_LIMIT
    return kwargs


def usual_kwargs(env_id: str) -> dict[str, Any]:
    """The default arguments of an environment, as far as they are known."""
    parameters, registered = _parameters(env_id), gym.spec(env_id)
    defaults = {p.name: p.default for p in parameters.values() if p.default is not p.empty}
    limit = {"max_episode_steps": registered.max_episode_steps}
    return {**limit, **defaults, **registered.kwargs}


def training_changes(spec: TrainSpec) -> tuple[str, ...]:
    """How training's environment differs from the one of evaluations, in words; often empty.

    The returns of a training with changes are not compared with the optimum.
    """
    usual = {**usual_kwargs(spec.env_id), **spec.env_kwargs}
    training, evaluation, told = spec.train_env_kwargs, spec.eval_env_kwargs, []
    for key in {**training, **evaluation}:
        if key == "max_episode_steps" and key not in training:
            continue  # evaluations need a limit where the environment has none
        value, other = (kwargs.get(key, usual.get(key)) for kwargs in (training, evaluation))
        words = "random starts" if (key, value) == ("random_start", True) else f"{key} {value}"
        if key == "max_episode_steps":
            value, other = (None if limit == -1 else limit for limit in (value, other))
            words = f"episodes of {value} steps" if value else "no time limit"
        if value != other:
            told.append(words)
    for wrapper in spec.train_env_wrapper:
        given = (wrapper.kwargs.get(key) for key in ("min_reward", "max_reward"))
        bounds = [f"{bound:g}" for bound in given if bound is not None]
        name = wrapper.name.rpartition(".")[2]
        if name == "ScaleReward" and "scale" in wrapper.kwargs:
            name = f"rewards x {wrapper.kwargs['scale']:g}"
        elif name == "ClipReward" and bounds:
            name = f"rewards clipped at {' and '.join(bounds)}"
        told.append(name)
    return tuple(told)


def remembers(spec: TrainSpec) -> bool:
    """Whether the agent is recurrent or observations are stacked, according to the settings."""
    entry = ALGORITHMS.get(spec.algo)
    return (entry is not None and entry.has_memory) or (spec.frame_stack or 1) > 1


def check_fit(spec: TrainSpec) -> None:
    """Raise UserError if the agent cannot work with the wrapped environment."""
    with closing(make_single_env(spec, training=True)) as env:
        if misfit := ALGORITHMS[spec.algo].env_misfit(env):
            spaces = env.observation_space, env.action_space
            fitting = fitting_algorithms(*spaces, is_bandit(env), wrappers.has_masks(env))
            ways = [f"fitting agents: {', '.join(fitting)}"] if fitting else []
            ways += [f"add {flag}" for flag in _fitting_wrappers(spec, env)]
            others = "; or ".join(ways) or "no agent here fits"
            raise UserError(f"{spec.algo} does not fit {spec.env_id}: {misfit}; {others}")


def _fitting_wrappers(spec: TrainSpec, env: Env) -> Iterator[str]:
    """The flag for each shipped wrapper around which the agent fits."""
    space = env.observation_space
    bins: dict[str, Any] = {"bins": 10}
    if isinstance(space, gym.spaces.Box) and not space.is_bounded():
        bins |= {"low": -3.0, "high": 3.0}
    for kind, kwargs in ((wrappers.FlattenToDiscrete, {}), (wrappers.DiscretizeObservation, bins)):
        with suppress(ValueError):
            wrapped: Any = kind(env, **kwargs)
            n = getattr(wrapped.observation_space, "n", 0)
            if n > MOST_BOXES or ALGORITHMS[spec.algo].env_misfit(wrapped):
                continue
            name = f"{kind.__module__}.{kind.__name__}"
            words = ", ".join(f"{key}: {value}" for key, value in kwargs.items())
            typed = f"env_wrapper:{{{name}: {{{words}}}}}" if kwargs else f"env_wrapper:{name}"
            yield f"-params {shlex.quote(typed)}"


# --- making them ----------------------------------------------------------------------------------


def _wrapped(spec: TrainSpec, env: Env, training: bool, folder: Path | None = None) -> Env:
    """An environment in its wrappers, with masks outermost for agents that need them."""
    for where in ("env_wrapper", *(["train_env_wrapper"] if training else [])):
        for component in getattr(spec, where):
            env = build(component, gym.Wrapper, where, spec.gym_packages, folder, env)
    entry = ALGORITHMS.get(spec.algo)
    env = env if entry is None else entry.numbered(env)
    # Without masks, `check_fit` names the agents that fit.
    needs_masks = entry is not None and entry.needs_masks and wrappers.has_masks(env)
    with as_user_error("mask_actions", ValueError):
        is_masked = spec.algorithm.get("mask_actions", False) or needs_masks
        return wrappers.ActionMasks(env) if is_masked else env


def make_single_env(spec: TrainSpec, training: bool = False, **extra: Any) -> Env:
    """Make one wrapped environment, outside any VecEnv; ``extra`` are further arguments of it."""
    env = make_env(spec.env_id, {**kwargs_of(spec, training), **extra})
    return _wrapped(spec, env, training)


def first_seed(spec: TrainSpec) -> int:
    """The seed of the first training environment; each further one adds 1.

    Two runs with different seeds and equally many environments share no seed.
    """
    return spec.seed * spec.n_envs


def make_training_env(spec: TrainSpec, folder: Path | None, appending: bool = False) -> Any:
    """Make the training VecEnv; Monitors write into the folder, behind what is there if asked."""
    monitor = {**spec.monitor_kwargs, **({"override_existing": False} if appending else {})}
    return make_envs(spec.changed(monitor_kwargs=monitor), spec.n_envs, folder, training=True)


def make_envs(
    spec: TrainSpec,
    n_envs: int,
    folder: Path | None = None,
    wrap_innermost: Callable[[Env], Env] | None = None,
    training: bool = False,
    **extra: Any,
) -> Any:
    """Make a VecEnv, for evaluations or for training.

    Monitors write into ``folder``; ``wrap_innermost`` is put around each environment, inside all
    other wrappers; ``extra`` are further arguments of the environments.
    """
    from stable_baselines3.common import vec_env
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.env_util import make_vec_env

    in_processes = training and spec.vec_env == "subproc"

    def make(**kwargs: Any) -> Env:
        import_modules(spec.gym_packages if in_processes else [])
        env = make_env(spec.env_id, {**kwargs, **extra})
        return env if wrap_innermost is None else wrap_innermost(env)

    env: Any = make_vec_env(
        make,
        n_envs,
        first_seed(spec) if training else None,
        env_kwargs=kwargs_of(spec, training),
        monitor_dir=None if folder is None else str(folder),
        monitor_kwargs=spec.monitor_kwargs,
        wrapper_class=lambda env: _wrapped(spec, env, training, folder),
        vec_env_cls=vec_env.SubprocVecEnv if in_processes else vec_env.DummyVecEnv,
    )
    for component in spec.vec_env_wrapper:
        where, base = "vec_env_wrapper", vec_env.VecEnvWrapper
        env = build(component, base, where, spec.gym_packages, folder, env)
    if spec.normalize is not None:
        # Statistics come from training, and evaluations report returns as they are.
        fixed = {} if training else {"norm_reward": False, "training": False}
        try:
            env = vec_env.VecNormalize(env, **{**spec.normalize, **fixed})
        except ValueError as error:  # of keys
            what = f"normalize: {one_line(error)}"
            raise UserError(f"{what}: the environment gives {env.observation_space}") from error
    if spec.frame_stack is not None:
        env = vec_env.VecFrameStack(env, spec.frame_stack)
    return BaseAlgorithm._wrap_env(env)


# --- files that arguments name --------------------------------------------------------------------


def with_files_read(env_id: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """An entry with the rows of each map in place of its file, and absolute paths of logs.

    So a run does not depend on the folder in which it was started.
    """
    found = dict(entry)
    for key in ("env_kwargs", "train_env_kwargs", "eval_env_kwargs"):
        kwargs: Any = found.get(key) if isinstance(found.get(key), dict) else {}
        desc, log = kwargs.get("desc"), kwargs.get("log")
        if isinstance(desc, str) and _makes(env_id, GridWorld | FrozenLakeEnv):
            with as_user_error(env_id, ValueError):
                found[key] = {**kwargs, "desc": list(read_rows(desc))}
        if isinstance(log, str) and _makes(env_id, ReplayBandit):
            found[key] = {**kwargs, "log": str(Path(log).absolute())}
    return found


def map_name(env_id: str, entry: Mapping[str, Any]) -> str:
    """The file name of the grid world map that is evaluated on; empty if it is in no file."""
    parts = [entry.get(key) or {} for key in ("eval_env_kwargs", "env_kwargs")]
    given: Any = next((part["desc"] for part in parts if "desc" in part), None)
    is_path = isinstance(given, str) and "\n" not in given and _makes(env_id, GridWorld)
    return Path(given).name if is_path else ""


def _makes(env_id: str, kind: Any) -> bool:
    creator = creator_of(env_id)
    return isinstance(creator, type) and issubclass(creator, kind)
