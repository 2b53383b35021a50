"""What may go wrong in a run, and whose fault it is.

A machine that has nothing left to give; code of the user's that raises what ends a program; a
library that gives up. Commands load this before their first words, so it imports little.
"""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import UserError, one_line
from pipeline.stopping import Stopped, current

# PyTorch's allocator, the dynamic linker, and Python's threads have no exception of their own.
_SIGNS = {
    "can't allocate memory": "memory",
    "cannot allocate memory": "memory",
    "failed to map segment": "memory",
    "out of memory": "memory",
    "can't start new thread": "threads or processes",
}


def exhaustion(error: BaseException) -> str | None:
    """Say in one line what the machine has run out of; None where that was not it."""
    text = one_line(error)
    if isinstance(error, MemoryError):
        return "this machine gives no more memory" + (f": {error}" if str(error) else "")
    for sign, what in _SIGNS.items():
        if sign in text.lower():
            return f"this machine gives no more {what}: {text}"
    return None


class OwnExit(SystemExit):  # no more an error than the one it is derived from
    """The end of a command by its own will."""


class ForeignExitError(UserError):
    """SystemExit or KeyboardInterrupt from code of the user's, where nobody pressed Ctrl-C."""

    def __init__(self, error: BaseException) -> None:
        kind, text = type(error).__name__, str(error)
        origin = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(origin.filename).name}:{origin.lineno}"
        super().__init__(f"{place}: {kind}{f': {text}' if text else ''}, which ends no command")


@contextmanager
def exits_as_mistakes() -> Iterator[None]:
    """Let what is called inside the ``with`` statement end no program: it has failed."""
    try:
        yield
    except OwnExit:
        raise
    except (SystemExit, KeyboardInterrupt) as error:
        # Where signals are noticed, or left to others, Ctrl-C raises no bare KeyboardInterrupt.
        if isinstance(error, KeyboardInterrupt) and (
            isinstance(error, Stopped)
            or current().number is not None
            or signal.getsignal(signal.SIGINT) is signal.default_int_handler
        ):
            raise
        raise ForeignExitError(error) from error


_LIBRARIES = frozenset({"torch", "stable_baselines3", "sb3_contrib", "mabwiser", "numpy", "scipy"})
_AROUND_THEM = frozenset({"agents", "pipeline", "gymnasium", *sys.stdlib_module_names})


class LibraryError(UserError):
    """A library cannot work with the settings of an agent."""


def blame_settings(algo: str, model: Any, error: Exception) -> None:
    """Blame an agent's settings where a library gave up, unless through code of the user's."""
    frames = list(traceback.walk_tb(error.__traceback__))
    packages = [str(frame.f_globals.get("__name__")).partition(".")[0] for frame, _ in frames]
    is_of_library = packages[-1] in _LIBRARIES and set(packages) <= _LIBRARIES | _AROUND_THEM
    if is_of_library and exhaustion(error) is None:
        frame, line = frames[-1]
        place = f"{packages[-1]}, {Path(frame.f_code.co_filename).name}:{line}"
        when = f"{algo} at step {model.num_timesteps:,}"
        raise LibraryError(f"{when}: {one_line(error)} ({place})") from error


def is_of_the_machine(error: BaseException | None) -> bool:
    """Whether a run has failed by a full disk or memory, and by no fault of its own."""
    from pipeline.files import DISK_ERRORS

    while error is not None:
        is_of_disk = isinstance(error, OSError) and error.errno in DISK_ERRORS
        if is_of_disk or exhaustion(error) is not None:
            return True
        error = error.__cause__
    return False
