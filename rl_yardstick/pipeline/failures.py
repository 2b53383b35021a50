"""Classifies failures of a run by their cause: the machine, the user's code, or a library.

The machine runs out of a resource; the user's code raises SystemExit; a library fails. Commands
load this module before their first output, so it imports little.
"""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.stopping import Stopped, current

# Messages of errors without their own class: PyTorch's allocator, dynamic linker, Python's threads.
_SIGNS = {
    "can't allocate memory": "memory",
    "cannot allocate memory": "memory",
    "failed to map segment": "memory",
    "out of memory": "memory",
    "can't start new thread": "threads or processes",
}


def exhaustion(error: BaseException) -> str | None:
    """Say in one line what the machine has run out of; None for other errors."""
    text = one_line(error)
    if isinstance(error, MemoryError):
        return "this machine gives no more memory" + (f": {error}" if str(error) else "")
    for sign, what in _SIGNS.items():
        if sign in text.lower():
            return f"this machine gives no more {what}: {text}"
    return None


class OwnExit(SystemExit):  # not an error, like its base class
    """A command ends itself."""


class ForeignExitError(UserError):
    """The user's code raised SystemExit or KeyboardInterrupt without Ctrl-C."""

    def __init__(self, error: BaseException) -> None:
        kind, text = type(error).__name__, str(error)
        origin = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(origin.filename).name}:{origin.lineno}"
        super().__init__(f"{place}: {kind}{f': {text}' if text else ''}, which ends no command")


@contextmanager
def exits_as_mistakes() -> Iterator[None]:
    """Treat an exit inside the ``with`` statement as a failure of the called code."""
    try:
        yield
    except OwnExit:
        raise
    except (SystemExit, KeyboardInterrupt) as error:
        # With `stops_noticed` or other handlers, Ctrl-C raises no plain KeyboardInterrupt.
        if isinstance(error, KeyboardInterrupt) and (
            isinstance(error, Stopped)
            or current().number is not None
            or signal.getsignal(signal.SIGINT) is signal.default_int_handler
        ):
            raise
        raise ForeignExitError(error) from error


_LIBRARIES = frozenset({"torch", "stable_baselines3", "sb3_contrib", "mabwiser", "numpy", "scipy"})
_AROUND_THEM = frozenset({"rl_yardstick", "gymnasium", *sys.stdlib_module_names})


class LibraryError(UserError):
    """A library cannot work with the settings of an agent."""


def blame_settings(algo: str, model: Any, error: Exception) -> None:
    """Turn a library's error into one about the settings, unless the user's code raised it."""
    frames = list(traceback.walk_tb(error.__traceback__))
    packages = [str(frame.f_globals.get("__name__")).partition(".")[0] for frame, _ in frames]
    is_of_library = packages[-1] in _LIBRARIES and set(packages) <= _LIBRARIES | _AROUND_THEM
    if is_of_library and exhaustion(error) is None:
        frame, line = frames[-1]
        place = f"{packages[-1]}, {Path(frame.f_code.co_filename).name}:{line}"
        when = f"{algo} at step {model.num_timesteps:,}"
        raise LibraryError(f"{when}: {one_line(error)} ({place})") from error


def is_of_the_machine(error: BaseException | None) -> bool:
    """Whether a run has failed because disk or memory is full."""
    from rl_yardstick.pipeline.files import DISK_ERRORS

    while error is not None:
        is_of_disk = isinstance(error, OSError) and error.errno in DISK_ERRORS
        if is_of_disk or exhaustion(error) is not None:
            return True
        error = error.__cause__
    return False
