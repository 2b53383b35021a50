"""Gymnasium environments whose optimum is known exactly; importing the package registers them.

Gymnasium imports it by itself for an id such as ``rl_yardstick.envs:Warehouse-v0``.
"""

from __future__ import annotations

import importlib
from typing import Any

from rl_yardstick.envs.registration import register_environments

__all__ = ["ModelCheck", "check_transition_model"]  # loaded when asked for

register_environments()


def __getattr__(name: str) -> Any:
    # Loaded on first use: registering environments is all that most need.
    if name not in __all__:
        raise AttributeError(f"module 'rl_yardstick.envs' has no attribute {name!r}")
    return getattr(importlib.import_module("rl_yardstick.envs.checking"), name)
