"""Builds objects that a settings file names: wrappers, callbacks, schedules, agents' arguments.

A name in a file can choose a class of a fixed kind from a fixed set of packages; it cannot import
or call anything else. A module is imported only if it belongs to this project, if the user typed
its name, or if its file is in the record of an installed distribution. A stranger's folder
``rl_zoo3`` is in no such record. All names are looked up and checked before any is used, so that
errors show before a run begins.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import inspect
import re
import site
import sysconfig
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path, PureWindowsPath
from types import ModuleType
from typing import TYPE_CHECKING, Any, get_args, get_origin

from rl_yardstick.pipeline.errors import UserError, did_you_mean, one_line, shown, unknown
from rl_yardstick.pipeline.settings.hyperparams import (
    Hyperparams,
    check_algorithm_kwargs,
    component_specs,
)
from rl_yardstick.pipeline.settings.values import (
    DottedName,
    ScheduleSpec,
    algorithm_parameters,
    check_arguments,
    constructor_parameters,
)
from rl_yardstick.pipeline.user_modules import is_ours

if TYPE_CHECKING:
    import gymnasium as gym
    from gymnasium import spaces
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.vec_env import VecEnv


# Wrapper arguments for the number of stacked observations, whose memory is allocated at once.
_STACKS = frozenset({"n_stack", "stack_size"})
_LONGEST_STACK = 10_000


@dataclass(frozen=True)
class _Component:
    """A checked class with checked arguments."""

    cls: type
    kwargs: dict[str, Any]
    where: str

    def build(self, *inner: Any) -> Any:
        """Build the object; for a wrapper, around ``inner``."""
        from gymnasium.error import Error

        try:
            return self.cls(*inner, **self.kwargs)
        except (TypeError, ValueError, AssertionError, Error) as error:
            raise UserError(f"{self.where}: {one_line(error)}") from error


def _wrapped(components: tuple[_Component, ...], env: Any) -> Any:
    for component in components:
        env = component.build(env)
    return env


def wrapper_factory(
    spec: Any,
    extra_packages: Sequence[str] = (),
    where: str = "env_wrapper",
    folder: Path | None = None,
) -> Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None:
    """Return a function that applies the wrappers of ``spec``, the first one innermost, or None."""
    from gymnasium import Wrapper

    components = _components(spec, Wrapper, extra_packages, where, 1, folder)
    return partial(_wrapped, components) if components else None


def vec_wrapper_factory(
    spec: Any,
    extra_packages: Sequence[str] = (),
    where: str = "vec_env_wrapper",
    folder: Path | None = None,
) -> Callable[[VecEnv], VecEnv] | None:
    """Like `wrapper_factory`, for wrappers of a vectorised environment."""
    from stable_baselines3.common.vec_env import VecEnvWrapper

    components = _components(spec, VecEnvWrapper, extra_packages, where, 1, folder)
    return partial(_wrapped, components) if components else None


def callbacks(
    spec: Any, extra_packages: Sequence[str] = (), save_path: Path | str | None = None
) -> list[BaseCallback]:
    """Build the callbacks that ``spec`` names."""
    from stable_baselines3.common.callbacks import BaseCallback

    folder = None if save_path is None else Path(save_path)
    defaults = {} if folder is None else {"save_path": str(folder)}
    components = _components(spec, BaseCallback, extra_packages, "callback", 0, folder, **defaults)
    return [component.build() for component in components]


def build_value(
    raw: Any, extra_packages: Sequence[str] = (), where: str = "hyperparameters"
) -> Any:
    """Replace names and schedules in nested values by classes and schedule objects."""
    if isinstance(raw, dict):
        return {
            key: build_value(value, extra_packages, f"{where}: {key}") for key, value in raw.items()
        }
    if isinstance(raw, list | tuple):
        return type(raw)(build_value(value, extra_packages, where) for value in raw)
    if isinstance(raw, ScheduleSpec):
        from stable_baselines3.common.utils import LinearSchedule

        from rl_yardstick.agents.common.schedules import ExponentialSchedule

        if raw.kind == "linear":
            return LinearSchedule(raw.start, raw.end, 1.0)
        return ExponentialSchedule(raw.start, raw.end)
    if isinstance(raw, DottedName):
        from stable_baselines3.common.buffers import BaseBuffer
        from torch import nn, optim

        bases = (nn.Module, optim.Optimizer, BaseBuffer)
        return find_class(raw.name, bases, where, extra_packages)
    return raw


def _components(
    spec: Any,
    base: type,
    extra_packages: Sequence[str],
    where: str,
    n_inner: int,
    folder: Path | None,
    **defaults: str,
) -> tuple[_Component, ...]:
    """Check classes derived from ``base``; they may write to ``folder``, or a temporary one."""
    components = []
    for item in component_specs(spec, where):
        cls = find_class(item.name, (base,), where, extra_packages)
        place = f"{where}: {item.name}"
        accepted = dict(list(constructor_parameters(cls).items())[n_inner:])
        given = {key: value for key, value in defaults.items() if key in accepted}
        kwargs = given | confined(check_arguments(item.kwargs, accepted, place), folder, place)
        for name in _STACKS & kwargs.keys():
            if isinstance(kwargs[name], int) and kwargs[name] > _LONGEST_STACK:
                raise UserError(f"{place}: {name} must be at most {_LONGEST_STACK:,}")
        for name, parameter in accepted.items():
            is_variable = parameter.kind in {parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD}
            if parameter.default is parameter.empty and name not in kwargs and not is_variable:
                raise UserError(f"{place}: argument {name!r} is missing")
            kind = str(parameter.annotation).partition("[")[0]  # argument accepts only functions
            if kwargs.get(name) is not None and "Callable" in kind and "|" not in kind:
                raise UserError(f"{place}: {name} is a function, which settings cannot hold")
        components.append(_Component(cls, build_value(kwargs, extra_packages, place), place))
    return tuple(components)


# The folders that hold these required libraries count as folders of installed packages.
_REQUIRED = ("stable_baselines3", "gymnasium", "torch")

_LIBRARIES = ("stable_baselines3", "sb3_contrib", "gymnasium", "torch.nn", "torch.optim")
# Of rl_zoo3 only two modules: importing the package changes Gymnasium's time limit.
_PACKAGES = (*_LIBRARIES, "rl_zoo3.wrappers", "rl_zoo3.callbacks", "rl_yardstick")

# The short names in rl_zoo3's files.
_MODULE_ALIASES = {"nn": "torch.nn", "th": "torch", "sb3": "stable_baselines3", "gym": "gymnasium"}
_CLASS_ALIASES = {
    "RMSpropTFLike": "stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike",
    "HerReplayBuffer": "stable_baselines3.her.her_replay_buffer.HerReplayBuffer",
}


def find_class(
    name: str, bases: tuple[type, ...], where: str, extra_packages: Sequence[str] = ()
) -> type:
    """Import a subclass of ``bases``, such as ``nn.Tanh``, if its name is allowed."""
    first, dot, rest = _CLASS_ALIASES.get(name, name).partition(".")
    module_name, _, class_name = f"{_MODULE_ALIASES.get(first, first)}{dot}{rest}".rpartition(".")
    parts = [*module_name.split("."), class_name]
    if not all(part.isidentifier() and not part.startswith("_") for part in parts):
        raise UserError(f"{where}: {name!r} is not the dotted name of a class")
    packages = (*_PACKAGES, *extra_packages)
    if not any(f"{module_name}.".startswith(f"{package}.") for package in packages):
        fault = f"none of the packages that may be named ({', '.join(packages)})"
        raise UserError(f"{where}: {name} is in {fault}; admit others with --gym-packages")
    module = _import(module_name, f"{where}: {name}", extra_packages)
    found = getattr(module, class_name, None)
    if isinstance(found, type) and issubclass(found, bases):
        return found
    wanted = " or ".join(base.__name__ for base in bases)
    fault = "does not exist" if found is None else f"is no {wanted}"
    classes = {name: value for name, value in vars(module).items() if isinstance(value, type)}
    known = [n for n, cls in classes.items() if issubclass(cls, bases) and cls not in bases]
    hint = did_you_mean(class_name, known)
    raise UserError(f"{where}: {name} {fault}{': ' + hint if hint else ''}")


def _import(module_name: str, what: str, typed: Sequence[str]) -> ModuleType:
    """Import a module after checking each of its parent packages."""
    parts = module_name.split(".")
    try:
        for end in range(1, len(parts) + 1):
            name = ".".join(parts[:end])
            around = (sorted((f"{name}.", f"{one}."), key=len) for one in typed)
            is_typed = any(longer.startswith(shorter) for shorter, longer in around)
            if not (is_ours(name) or is_typed or _is_installed(name)):
                raise UserError(
                    f"{what}: {name} belongs to no package that is installed; if you trust it, "
                    f"type --gym-packages {parts[0]}"
                )
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        reason = f"there is no module {error.name}, or it is not installed"
        raise UserError(f"{what}: {reason}") from error
    except ImportError as error:
        raise UserError(f"{what}: cannot be imported: {error}") from error


def _is_installed(name: str) -> bool:
    """Whether a module's file is in the record of the installed distribution of that name."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # `sys.modules` has something else under that name
        return False
    if spec is None:
        raise ModuleNotFoundError(name=name)
    if spec.origin is None:
        return False
    path = Path(spec.origin)
    folder = next((each for each in _folders() if path.is_relative_to(each)), None)
    if folder is None:
        return False
    return path.relative_to(folder).as_posix() in _record(name.partition(".")[0], folder)


@cache
def _folders() -> tuple[Path, ...]:
    """The folders of installed packages, excluding the current folder and PYTHONPATH."""
    paths = sysconfig.get_paths()
    places = [paths["purelib"], paths["platlib"], *site.getsitepackages()]
    places += [site.getusersitepackages()] if site.ENABLE_USER_SITE else []
    found = {name: importlib.util.find_spec(name) for name in _REQUIRED}
    beside = {
        name: Path(spec.origin).parents[1] for name, spec in found.items() if spec and spec.origin
    }
    required = [one for name, one in beside.items() if f"{name}/__init__.py" in _record(name, one)]
    return tuple(dict.fromkeys([*required, *map(Path, places)]))


@cache
def _record(distribution: str, folder: Path) -> frozenset[str]:
    """The files of a distribution in a folder of packages, relative to the folder."""
    found = importlib.metadata.distributions(name=distribution, path=[str(folder)])
    texts = [one.read_text("RECORD") or "" for one in found]
    return frozenset(line.rsplit(",", 2)[0] for text in texts for line in text.splitlines())


_NAME_OF_A_PLACE = re.compile(
    r"path|folder|file|prefix|dir$|(^|_)(log|logs|dir|directory)(_|$)", re.IGNORECASE
)


def names_a_place(argument: str) -> bool:
    """Whether an argument of that name is an output path."""
    return _NAME_OF_A_PLACE.search(argument) is not None


def confined(value: Any, folder: Path | None, where: str, name: str = "") -> Any:
    """Make paths among the arguments relative to the folder; refuse paths that lead out of it."""
    if isinstance(value, dict):
        return {
            key: confined(item, folder, f"{where}: {key}", f"{name}_{key}")
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return type(value)(confined(item, folder, where, name) for item in value)
    if not (isinstance(value, str | Path) and names_a_place(name)):
        return value
    path = PureWindowsPath(value)  # accepts both slashes; a drive letter leads out too
    if "prefix" in name.lower():
        if path.name == str(value) != "..":
            return str(value)
        what = "begins the names of files and holds no path"
        raise UserError(f"{where} {what}, unlike {shown(str(value))}")
    folder = Path(_scratch().name) if folder is None else folder
    leads_out = bool(path.anchor) or ".." in path.parts or "\0" in str(value)
    # Links are followed first.
    if leads_out or not (folder / value).resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{where} must lie inside the run folder, unlike {shown(str(value))}")
    return str(folder / value)


_scratch = cache(
    partial(tempfile.TemporaryDirectory, prefix="yardstick-", ignore_cleanup_errors=True)
)


def build_algorithm_kwargs(
    algorithm: type[BaseAlgorithm],
    kwargs: Mapping[str, Any],
    where: str,
    extra_packages: Sequence[str] = (),
) -> dict[str, Any]:
    """Check and build the arguments of an agent's constructor, including ``policy_kwargs``."""
    from rl_yardstick.agents.common.model_files import JsonAlgorithm
    from rl_yardstick.agents.common.schedules import ExponentialSchedule, library_schedule

    parameters = algorithm_parameters(algorithm)
    checked = check_algorithm_kwargs(kwargs, parameters, where)
    policy = _policy_class(algorithm, checked, parameters, where, extra_packages)
    if policy is not None and checked.get("policy_kwargs") is not None:
        accepted = constructor_parameters(policy)
        policy_kwargs = check_arguments(
            checked["policy_kwargs"], accepted, f"{where}: policy_kwargs"
        )
        checked["policy_kwargs"] = _build(policy_kwargs, accepted, where, extra_packages)
    if isinstance(checked.get("policy"), DottedName):
        checked["policy"] = policy
    built = _build(checked, parameters, where, extra_packages)
    if issubclass(algorithm, JsonAlgorithm):
        return built
    # A zip of a library agent must load without this project's classes.
    return {
        name: library_schedule(value) if isinstance(value, ExponentialSchedule) else value
        for name, value in built.items()
    }


def needs_policy(algorithm: type[BaseAlgorithm], kwargs: Mapping[str, Any]) -> bool:
    """Whether the constructor requires a policy and the arguments have none."""
    policy = algorithm_parameters(algorithm).get("policy")
    return policy is not None and policy.default is policy.empty and "policy" not in kwargs


def default_policy(algorithm: type[BaseAlgorithm], is_dict: bool) -> str:
    """The default policy of an agent."""
    prefix = "MultiInput" if is_dict else "Mlp"
    known = algorithm.policy_aliases
    fitting = (name for name in known if name.startswith(prefix))
    return next(fitting, next(iter(known), f"{prefix}Policy"))


def _policy_class(
    algorithm: type[BaseAlgorithm],
    kwargs: Mapping[str, Any],
    parameters: Mapping[str, inspect.Parameter],
    where: str,
    extra_packages: Sequence[str],
) -> type[BasePolicy] | None:
    """The class of the policy; None if only the agent's constructor knows it."""
    from stable_baselines3.common.policies import BasePolicy

    if needs_policy(algorithm, kwargs):
        raise UserError(f"{where}: policy is missing: {', '.join(algorithm.policy_aliases)}")
    default = parameters["policy"].default if "policy" in parameters else None
    policy = kwargs.get("policy", default)
    if isinstance(policy, DottedName):
        return find_class(policy.name, (BasePolicy,), f"{where}: policy", extra_packages)
    known = algorithm.policy_aliases
    if isinstance(policy, str) and known and policy not in known and "policy" in kwargs:
        raise unknown(f"{where}: unknown policy", policy, known)
    return known.get(policy) if isinstance(policy, str) else None


def _build(
    kwargs: Mapping[str, Any],
    parameters: Mapping[str, inspect.Parameter],
    where: str,
    extra_packages: Sequence[str],
) -> dict[str, Any]:
    """Build each argument, and check classes against ``type[...]`` annotations."""
    built = {}
    for name, value in kwargs.items():
        built[name] = build_value(value, extra_packages, f"{where}: {name}")
        annotation = parameters[name].annotation if name in parameters else None
        bases = tuple(
            get_args(option)[0]
            for option in (annotation, *get_args(annotation))
            if get_origin(option) is type
        )
        if isinstance(value, DottedName) and bases and not issubclass(built[name], bases):
            wanted = " or ".join(base.__name__ for base in bases)
            raise UserError(f"{where}: {name}: {value} is no {wanted}")
    return built


def check_action_noise(hyperparams: Hyperparams, algorithm: type[BaseAlgorithm], algo: str) -> None:
    """Check that the agent accepts action noise if the settings ask for it."""
    taken = constructor_parameters(algorithm)
    if hyperparams.noise_type is not None and "action_noise" not in taken:
        raise UserError(
            f"{algo}: noise_type is for agents that add noise to continuous actions, such as td3"
        )


def action_noise(hyperparams: Hyperparams, actions: spaces.Space[Any]) -> dict[str, Any]:
    """The argument ``action_noise``, for actions scaled to [-1, 1]; empty without noise."""
    if hyperparams.noise_type is None:
        return {}
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
    mean = np.zeros(actions.shape or ())
    sigma = np.full_like(mean, hyperparams.noise_std)
    return {"action_noise": kinds[hyperparams.noise_type](mean, sigma)}
