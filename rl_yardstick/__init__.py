"""Reinforcement learning measured against the exact optimum; in Python, see `rl_yardstick.api`."""

from importlib import import_module
from typing import Any

_API: tuple[str, ...] = ("Run", "Study", "audit", "check_env", "compare", "explain", "judge")
_API += ("model", "optimum", "train", "tune")
_ELSEWHERE = {"rate": "rating.ratings", "UserError": "pipeline.errors"}
_HOMES = dict.fromkeys(_API, "api") | _ELSEWHERE
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
