"""Standard output and error where nobody reads them any more, or nothing can be written."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any, TextIO

from pipeline.failures import OwnExit


class Output:
    """A standard stream, and what happens once it takes nothing more.

    The file below is replaced then, so that the interpreter's last flush does not complain either.

    Args:
        stream: the stream as Python opened it.
        goes_on: whether to let what is printed get lost, and go on.
    """

    def __init__(self, stream: TextIO, *, goes_on: bool) -> None:
        self._stream = stream
        self.goes_on = goes_on
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, as far as it can be written.

        Raises:
            OwnExit: if the reader has gone, as ``head`` does, and the work was for him alone.
            OSError: if it cannot be written otherwise, likewise.
        """
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Hand on what was written; what is raised is as in `write`."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Any, *args: str) -> None:
        if self.failure is None:
            try:
                action(*args)
            except OSError as error:
                self._give_up(error)
        if self.failure is None or self.goes_on:
            return
        is_main = threading.current_thread() is threading.main_thread()
        if isinstance(self.failure, BrokenPipeError) and is_main:  # else it would end that thread
            raise OwnExit(0)
        raise self.failure

    def _give_up(self, error: OSError) -> None:
        self.failure = error
        # Anything may stand in for a standard stream, also what has no file below.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        if self.goes_on and self is sys.stdout and not isinstance(error, BrokenPipeError):
            program = os.path.basename(sys.argv[0])  # noqa: PTH119  # a name, not a path
            reason = f"what it prints is lost: {error.strerror}"
            sys.stderr.write(f"{program}: {reason}\n")


@contextlib.contextmanager
def standard_streams() -> Iterator[Output]:
    """Put an `Output` in the place of both standard streams.

    Yields:
        That of standard output, which does not go on without a reader until it is told so.
    """
    _open_closed_ones()
    before = sys.stdout, sys.stderr
    output = Output(sys.stdout, goes_on=False)
    sys.stdout, sys.stderr = output, Output(sys.stderr, goes_on=True)
    try:
        yield output
    finally:
        sys.stdout, sys.stderr = before


def go_on_unread() -> None:
    """From now on the work counts, and not what is printed of it."""
    if isinstance(sys.stdout, Output):
        sys.stdout.goes_on = True


def _open_closed_ones() -> None:
    """Open the standard streams that this process was started without, on nothing.

    Otherwise the next file that is opened would get their number, and what is printed.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  # until the exit
            setattr(sys, name, nowhere)
