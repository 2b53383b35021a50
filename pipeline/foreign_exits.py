"""Environments, callbacks and modules of the user's that raise what ends a program."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import UserError
from pipeline.stopping import Stopped, current


class OwnExit(SystemExit):  # no more an error than the one it is derived from
    """The end of a command by its own will."""


class ForeignExitError(UserError):
    """SystemExit or KeyboardInterrupt from code of the user's, where nobody pressed Ctrl-C.

    Args:
        error: what was raised.
    """

    def __init__(self, error: BaseException) -> None:
        kind, text = type(error).__name__, str(error)
        origin = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(origin.filename).name}:{origin.lineno}"
        super().__init__(f"{place}: {kind}{f': {text}' if text else ''}, which ends no command")


@contextmanager
def exits_as_mistakes() -> Iterator[None]:
    """Let what is called inside the ``with`` statement end no program: it has failed.

    Raises:
        ForeignExitError: in the place of a SystemExit, and of a KeyboardInterrupt that no signal
            has caused.
    """
    try:
        yield
    except OwnExit:
        raise
    except (SystemExit, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) and _may_be_of_a_signal(error):
            raise
        raise ForeignExitError(error) from error


def _may_be_of_a_signal(error: KeyboardInterrupt) -> bool:
    if isinstance(error, Stopped) or current().number is not None:
        return True
    # Where signals are noticed, or left to somebody else, Ctrl-C raises no bare KeyboardInterrupt.
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler
