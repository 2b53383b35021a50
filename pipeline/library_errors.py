"""What libraries raise in the midst of a training, of settings that they cannot work with."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path
from typing import Any

from pipeline.errors import UserError, one_line
from pipeline.exhaustion import exhaustion
from pipeline.finite_numbers import NotFiniteError, check_model

_LIBRARIES = frozenset({"torch", "stable_baselines3", "sb3_contrib", "mabwiser", "numpy", "scipy"})
_AROUND_THEM = frozenset({"agents", "pipeline", "gymnasium", *sys.stdlib_module_names})


class LibraryError(UserError):
    """A library cannot work with the settings of an agent."""


def blame_weights(model: Any, error: Exception) -> None:
    """Say that an agent's weights are at fault, where they are.

    PyTorch refuses distributions of nan, and does not say where they come from.

    Raises:
        NotFiniteError: naming them.
    """
    try:
        check_model(model)
    except NotFiniteError as cause:
        raise cause from error


def blame_settings(algo: str, model: Any, error: Exception) -> None:
    """Say that an agent's settings are at fault, where a library gave up over them.

    What went through an environment, a callback or a module of the user's may be a mistake in
    there, and keeps its traceback.

    Raises:
        LibraryError: naming the step, and the line of the library.
    """
    frames = list(traceback.walk_tb(error.__traceback__))
    packages = [str(frame.f_globals.get("__name__")).partition(".")[0] for frame, _ in frames]
    is_of_library = packages[-1] in _LIBRARIES and set(packages) <= _LIBRARIES | _AROUND_THEM
    if is_of_library and exhaustion(error) is None:
        frame, line = frames[-1]
        place = f"{packages[-1]}, {Path(frame.f_code.co_filename).name}:{line}"
        when = f"{algo} at step {model.num_timesteps:,}"
        raise LibraryError(f"{when}: {one_line(error)} ({place})") from error
