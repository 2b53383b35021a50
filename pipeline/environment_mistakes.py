"""What was wrong with the arguments of an environment that could not be made."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium as gym

from pipeline.errors import UserError, one_line, shown, unknown

# What `gymnasium.make` takes itself.
_OF_MAKE = ("max_episode_steps", "render_mode")
# It adds this to some errors, and all arguments once more.
_ADDED = " was raised from the environment creator"


def environment_mistake(env_id: str, kwargs: Mapping[str, Any], error: Exception) -> UserError:
    """The line for an environment that raised ``error`` when it was made with ``kwargs``."""
    parameters, module = _creator(env_id)
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    foreign = next((name for name in kwargs if name not in (*parameters, *_OF_MAKE)), None)
    if foreign is not None and parameters and not takes_any:
        known = [name for name in (*parameters, *_OF_MAKE) if name != "render_mode"]
        return unknown(f"{env_id}: unknown argument", foreign, known)
    if isinstance(error, KeyError):
        return _missing_key(env_id, kwargs, error, parameters, module)
    what = one_line(error).partition(_ADDED)[0]
    if kwargs and not any(name in what for name in kwargs):
        what += f" (with {', '.join(f'{name}={shown(value)}' for name, value in kwargs.items())})"
    return UserError(f"{env_id}: {what}")


@contextmanager
def lacking_packages_told(env_id: str) -> Iterator[None]:
    """Say in a line which package an environment lacks, as it may only find when it is drawn.

    Raises:
        UserError: in the place of Gymnasium's own error.
    """
    try:
        yield
    except gym.error.DependencyNotInstalled as error:
        raise UserError(f"{env_id}: {one_line(error)}") from error


def _creator(env_id: str) -> tuple[Mapping[str, inspect.Parameter], str]:
    """The parameters of what makes the environment, and its module; empty where not known."""
    entry_point = gym.spec(env_id.rpartition(":")[2]).entry_point
    try:
        creator: Any = (
            gym.envs.registration.load_env_creator(entry_point)
            if isinstance(entry_point, str)
            else entry_point
        )
        return inspect.signature(creator).parameters, creator.__module__
    except (ImportError, AttributeError, TypeError, ValueError):
        return {}, ""


def _missing_key(
    env_id: str,
    kwargs: Mapping[str, Any],
    error: KeyError,
    parameters: Mapping[str, inspect.Parameter],
    module: str,
) -> UserError:
    """The environment looked something up that is not there: an argument, as a rule."""
    key = error.args[0] if error.args else None
    name = next((name for name, value in kwargs.items() if value is key or value == key), None)
    if name is None:
        return UserError(f"{env_id}: it looks for {shown(key)}, which is not there")
    default = parameters[name].default if name in parameters else None
    return unknown(f"{env_id}: unknown {name}", str(key), _keys_beside(default, module))


def _keys_beside(default: Any, module: str) -> Iterable[str]:
    """The keys of a table in the module that has the default of an argument among its own."""
    tables = [v for v in vars(sys.modules.get(module, object)).values() if isinstance(v, dict)]
    found = next((t for t in tables if isinstance(default, str) and default in t), {})
    return map(str, found)
