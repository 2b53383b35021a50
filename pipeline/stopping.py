"""How a command is stopped: Ctrl-C, SIGTERM and SIGHUP all ask for the same, and lose nothing.

Within `stops_noticed` the first signal raises `Stopped` in the main thread, as Ctrl-C raises
KeyboardInterrupt: at once, or where the work can wait for a better moment, then or when it has
waited long enough. The second one waits for nothing but what is `held`. The third ends the process
as if nothing were in its way.
"""

from __future__ import annotations

import _thread
import contextlib
import math
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Those that a platform lacks are left out: Windows has no SIGHUP.
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

# A key that is held down, or a shell that hands on the signal of a closed terminal, asks once.
SECONDS_OF_ONE_REQUEST = 0.2
# What swallows the exception, as a bare `except` does, is told again.
SECONDS_BEFORE_RAISING_AGAIN = 0.5
_SECONDS_BETWEEN_LOOKS = 0.02


class Stopped(KeyboardInterrupt):
    """A signal asked the process to stop.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    def __str__(self) -> str:
        return signal.Signals(self.number).name


class StopRequest:
    """What signals have asked for, and how long it may wait.

    Attributes:
        number: the first signal that asked, or None.
        n_asked: how often; signals in quick succession count once.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.n_asked = 0
        self._asked_at = self._signalled_at = self._raised_at = -math.inf
        self._patience = 0.0  # seconds
        self._reminds = False
        self._is_reminder = False
        self._is_over = False
        self._reminding = threading.Lock()

    @property
    def is_urgent(self) -> bool:
        """Whether a second signal has come: what can be left out should be."""
        return self.n_asked > 1

    def raise_if_asked(self) -> None:
        """Stop here, if a stop was asked for: call it where nothing is half done.

        Raises:
            Stopped: if so.
        """
        if self.number is not None:
            raise Stopped(self.number)

    @contextmanager
    def waiting(self, seconds: float) -> Iterator[None]:
        """Let a stop wait inside the ``with`` statement; inside another, this one counts.

        Args:
            seconds: for how long after the first signal, if `raise_if_asked` is not called before;
                0 for not at all. A second signal ends the waiting.

        Raises:
            Stopped: when the time is over, also at the beginning of the ``with`` statement; and
                in the place of any exception that a library made of it.
        """
        before = self._patience, self._reminds
        self._patience, self._reminds, self._raised_at = seconds, True, -math.inf
        try:
            if self._is_due():
                self.raise_if_asked()
            yield
        except Exception as error:
            if (stop := _stop_behind(error)) is None:
                raise
            raise Stopped(stop.number) from error
        finally:
            self._patience, self._reminds = before

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let nothing be raised inside the ``with`` statement, but in a `waiting` inside it."""
        before, self._patience = self._patience, math.inf
        try:
            yield
        finally:
            self._patience = before

    def notice(self, number: int, frame: FrameType | None = None) -> None:
        """Handle a signal.

        Raises:
            Stopped: if it need not wait.
        """
        if self._is_reminder:
            self._is_reminder = False
        else:
            self._count(number)
        if self._is_due():
            self._raised_at = time.monotonic()
            self.raise_if_asked()

    def _count(self, number: int) -> None:
        now = time.monotonic()
        is_another = now - self._signalled_at > SECONDS_OF_ONE_REQUEST
        self._signalled_at = now
        if self.number is None:
            self.number, self.n_asked, self._asked_at = number, 1, now
            _noticed.append(number)
            # A thread of `threading` takes locks that the interrupted code may hold.
            _thread.start_new_thread(self._remind, ())
        elif is_another:
            self.n_asked += 1
        if self.n_asked > 2:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    def _is_due(self) -> bool:
        now = time.monotonic()
        if self.number is None or self._patience == math.inf:
            return False
        if now < self._raised_at + SECONDS_BEFORE_RAISING_AGAIN:
            return False
        return self.is_urgent or now >= self._asked_at + self._patience

    def _remind(self) -> None:
        """Signal to the main thread when its time is over, wherever it waits."""
        assert self.number is not None
        while True:
            with self._reminding:
                if self._is_over:
                    return
                if self._reminds and self._is_due() and not self._is_reminder:
                    self._is_reminder = True
                    if sys.platform == "win32":
                        _thread.interrupt_main(signal.Signals(self.number))
                    else:  # unlike the other, this also ends a wait for input or another process
                        signal.pthread_kill(threading.main_thread().ident or 0, self.number)
            time.sleep(_SECONDS_BETWEEN_LOOKS)

    def end(self) -> None:
        """Remind no more."""
        with self._reminding:
            self._is_over = True


def _stop_behind(error: BaseException) -> Stopped | None:
    """The stop that an exception was made of, or raised while it was being handled."""
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        if isinstance(cause, Stopped):
            return cause
        seen.add(id(cause))
        cause = cause.__cause__ or cause.__context__
    return None


_current: list[StopRequest] = []
_noticed: list[int] = []


def n_stops() -> int:
    """How many of the `stops_noticed` of this process a signal has asked to stop."""
    return len(_noticed)


def current() -> StopRequest:
    """What signals have asked for; outside of `stops_noticed` nothing ever has."""
    if _current and threading.current_thread() is threading.main_thread():
        return _current[-1]
    return StopRequest()


@contextmanager
def stops_noticed() -> Iterator[StopRequest]:
    """Notice the signals that ask to stop; inside another such ``with`` statement, the same ones.

    A signal that is ignored from outside stays so, as ``nohup`` and a shell's ``&`` want it, and
    one that has a handler keeps it. Outside the main thread, where Python delivers no signals, none
    is noticed.
    """
    if _current or threading.current_thread() is not threading.main_thread():
        yield current()
        return
    request = StopRequest()
    before = {number: signal.getsignal(number) for number in SIGNALS}
    _current.append(request)
    try:
        for number, handler in before.items():
            if handler in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, request.notice)
        yield request
    finally:
        request._patience = math.inf  # before a call, in which a signal could still be handled
        request.end()
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
        _current.clear()


def default_for_signals() -> None:
    """Let signals end the process at once and without a word, where it has nothing more to do."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            with contextlib.suppress(ValueError):  # outside the main thread
                signal.signal(number, signal.SIG_DFL)
