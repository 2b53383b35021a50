"""From what a file names to objects: wrappers, callbacks, schedules and classes.

All are looked up and checked before any is used, so that a mistake shows before a run begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError, one_line
from pipeline.settings.class_names import find_class
from pipeline.settings.coercion import ScheduleSpec
from pipeline.settings.constructor_arguments import check_arguments, constructor_parameters
from pipeline.settings.file_arguments import confined
from pipeline.settings.hyperparams import component_specs
from pipeline.settings.literals import DottedName

if TYPE_CHECKING:
    import gymnasium as gym
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

# How wrappers call the number of observations that they stack, which take their memory at once.
_STACKS = frozenset({"n_stack", "stack_size"})
_LONGEST_STACK = 10_000


@dataclass(frozen=True)
class _Component:
    """A class and the arguments to build it with, both checked."""

    cls: type
    kwargs: dict[str, Any]
    where: str

    def build(self, *inner: Any) -> Any:
        """The object, around ``inner`` if it is a wrapper."""
        from gymnasium.error import Error

        try:
            return self.cls(*inner, **self.kwargs)
        except (TypeError, ValueError, AssertionError, Error) as error:
            raise UserError(f"{self.where}: {one_line(error)}") from error


@dataclass(frozen=True)
class _Chain:
    """Wraps an environment in one wrapper after another; can be pickled."""

    components: tuple[_Component, ...]

    def __call__(self, env: Any) -> Any:
        for component in self.components:
            env = component.build(env)
        return env


def wrapper_factory(
    spec: Any,
    extra_packages: Sequence[str] = (),
    where: str = "env_wrapper",
    folder: Path | None = None,
) -> Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None:
    """What wraps an environment as ``spec`` says, the first wrapper innermost.

    Args:
        spec: a dotted name, a mapping from it to arguments, a list of either, or None.
        extra_packages: packages that the user allows besides the usual ones.
        where: begins every error message.
        folder: that they may write to; None for a temporary one, see
            `pipeline.settings.file_arguments`.

    Returns:
        A function of the environment, or None if there is nothing to wrap.

    Raises:
        UserError: if a name is not that of a Gymnasium wrapper, or an argument does not fit it.
    """
    from gymnasium import Wrapper

    return _chain(spec, Wrapper, extra_packages, where, folder)


def vec_wrapper_factory(
    spec: Any,
    extra_packages: Sequence[str] = (),
    where: str = "vec_env_wrapper",
    folder: Path | None = None,
) -> Callable[[VecEnv], VecEnv] | None:
    """As `wrapper_factory`, for wrappers of a vectorised environment."""
    from stable_baselines3.common.vec_env import VecEnvWrapper

    return _chain(spec, VecEnvWrapper, extra_packages, where, folder)


def callbacks(
    spec: Any, extra_packages: Sequence[str] = (), save_path: Path | str | None = None
) -> list[BaseCallback]:
    """The callbacks that ``spec`` names.

    Args:
        spec: a dotted name, a mapping from it to arguments, a list of either, or None.
        extra_packages: packages that the user allows besides the usual ones.
        save_path: given to callbacks that have a ``save_path`` and are not told another; what
            they are told lies inside it.

    Raises:
        UserError: if a name is not that of a callback, or an argument does not fit it.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    folder = None if save_path is None else Path(save_path)
    defaults = {} if folder is None else {"save_path": str(folder)}
    components = _components(spec, BaseCallback, extra_packages, "callback", 0, folder, defaults)
    return [component.build() for component in components]


def build_value(
    raw: Any, extra_packages: Sequence[str] = (), where: str = "hyperparameters"
) -> Any:
    """Turn the names and schedules in nested values into classes and schedule objects.

    Args:
        raw: a value as `pipeline.settings.hyperparams.check_algorithm_kwargs` leaves it.
        extra_packages: packages that the user allows besides the usual ones.
        where: begins every error message.

    Raises:
        UserError: if a name is not that of a network module, an optimizer or a buffer.
    """
    if isinstance(raw, dict):
        return {
            key: build_value(value, extra_packages, f"{where}: {key}") for key, value in raw.items()
        }
    if isinstance(raw, list | tuple):
        return type(raw)(build_value(value, extra_packages, where) for value in raw)
    if isinstance(raw, ScheduleSpec):
        return _build_schedule(raw)
    if isinstance(raw, DottedName):
        return find_class(raw.name, _value_bases(), where, extra_packages)
    return raw


def _build_schedule(spec: ScheduleSpec) -> Callable[[float], float]:
    if spec.kind == "linear":
        from stable_baselines3.common.utils import LinearSchedule

        return LinearSchedule(spec.start, spec.end, 1.0)
    from agents.common.schedules import ExponentialSchedule

    return ExponentialSchedule(spec.start, spec.end)


def _value_bases() -> tuple[type, ...]:
    from stable_baselines3.common.buffers import BaseBuffer
    from torch import nn, optim

    return nn.Module, optim.Optimizer, BaseBuffer


def _chain(
    spec: Any, base: type, extra_packages: Sequence[str], where: str, folder: Path | None
) -> _Chain | None:
    components = _components(spec, base, extra_packages, where, 1, folder, {})
    return _Chain(components) if components else None


def _components(
    spec: Any,
    base: type,
    extra_packages: Sequence[str],
    where: str,
    n_inner: int,
    folder: Path | None,
    defaults: Mapping[str, Any],
) -> tuple[_Component, ...]:
    """Look up and check what ``spec`` names.

    Args:
        spec: in one of rl_zoo3's forms.
        base: what every class must derive from.
        extra_packages: packages that the user allows.
        where: begins every error message.
        n_inner: how many leading arguments a class is given when it is built.
        folder: that they may write to, or None for a temporary one.
        defaults: arguments for those classes that know them and are not told others.
    """
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
            if kwargs.get(name) is not None and _is_function(parameter.annotation):
                raise UserError(f"{place}: {name} is a function, which settings cannot hold")
        components.append(_Component(cls, build_value(kwargs, extra_packages, place), place))
    return tuple(components)


def _is_function(annotation: object) -> bool:
    """Whether an argument takes functions alone, as its type says."""
    kind = str(annotation).partition("[")[0]
    return "Callable" in kind and "|" not in kind
