"""Reads model files of unknown origin without running any code in them.

The package depends on the libraries whose files it reads, and on nothing else in this project.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rl_yardstick.safe_files.files import UnsafeFileError

if TYPE_CHECKING:
    from rl_yardstick.safe_files.buffers_and_statistics import (
        load_replay_buffer,
        load_vec_normalize,
    )
    from rl_yardstick.safe_files.models import Report, inspect_model, load_model

__all__ = [
    "Report",
    "UnsafeFileError",
    "inspect_model",
    "load_model",
    "load_replay_buffer",
    "load_vec_normalize",
]

# Lazy imports: the libraries take two seconds.
_MODULES = {
    "Report": "models",
    "inspect_model": "models",
    "load_model": "models",
    "load_replay_buffer": "buffers_and_statistics",
    "load_vec_normalize": "buffers_and_statistics",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"rl_yardstick.safe_files.{_MODULES[name]}"), name)
