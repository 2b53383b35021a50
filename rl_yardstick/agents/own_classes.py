"""Classes of the user as agents: plain ones with ``act`` and ``learn``, or of Stable-Baselines3.

Nothing heavy is imported, so that a class that does not fit is refused at once.
"""

from __future__ import annotations

import inspect
from functools import cache
from types import FunctionType
from typing import Any

SMALLEST = """\
the smallest class that works:
class MyAgent:
    def act(self, obs):
        return 0
    def learn(self, obs, action, reward, next_obs, terminated):
        pass"""
# Arguments of a plain class's constructor that are given; all others are hyperparameters.
GIVEN = ("observation_space", "action_space", "n_states", "n_actions", "seed", "env")
# What is given to methods.
_METHODS = {"act": "obs", "learn": "obs action reward next_obs terminated"}
_METHODS |= {"reset": "", "values": "obs"}


def is_plain(cls: Any) -> bool:
    """Whether a class is none of Stable-Baselines3's algorithms."""
    return isinstance(cls, type) and "BaseAlgorithm" not in [base.__name__ for base in cls.__mro__]


def fault_of(cls: Any) -> str:
    """Why an object is no class that can be trained; empty if it is one."""
    if not isinstance(cls, type):
        return f"is no class, but of type {type(cls).__name__}"
    lacks = [name for name in ("act", "learn") if not callable(getattr(cls, name, None))]
    if is_plain(cls) and lacks:
        has = [name for name in dir(cls) if not name.startswith("_")]
        return f"lacks {' and '.join(lacks)}; it has {', '.join(has) or 'no methods'}"
    for name in [one for one in _METHODS if is_plain(cls) and getattr(cls, one, None) is not None]:
        known, given = parameters_of(cls, name), _METHODS[name].split()
        signature = inspect.Signature([*known.values()])
        try:
            signature.bind(*given, **dict.fromkeys(known.keys() & {"explore", "truncated"}, True))
        except TypeError:
            return f"has {name}{signature}, which does not take ({', '.join(given)})"
    return ""


@cache
def parameters_of(cls: type, method: str = "") -> dict[str, inspect.Parameter]:
    """The parameters of a class's method without ``self``, or of its constructor."""
    try:
        known = dict(inspect.signature(getattr(cls, method) if method else cls).parameters)
    except (AttributeError, ValueError):  # there is no such method, or it is a builtin
        return {}
    if method and isinstance(inspect.getattr_static(cls, method), FunctionType):
        known.pop(next(iter(known), ""), None)
    return known


def hyperparameters_of(cls: type) -> dict[str, inspect.Parameter]:
    """The constructor's arguments but those in `GIVEN`; a whole number may be any number."""
    found = {}
    for name, one in parameters_of(cls).items():
        if name not in GIVEN and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD):
            is_number = one.annotation is one.empty and type(one.default) is int
            kind: Any = int | float if is_number else one.annotation
            found[name] = one.replace(kind=one.KEYWORD_ONLY, annotation=kind)
    return found
