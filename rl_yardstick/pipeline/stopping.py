"""Stops a command cleanly on Ctrl-C, SIGTERM and SIGHUP, without losing results.

Within `stops_noticed`, the first signal raises `Stopped` in the main thread, as Ctrl-C raises
KeyboardInterrupt: at once, or inside `waiting` at a better moment or after a time-out. The second
signal is delayed only by `held`. The third signal ends the process.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


# Without signals that a platform lacks: Windows has no SIGHUP.
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

# Repeated signals, from a held key or a shell that forwards SIGHUP, count as one request.
SECONDS_OF_ONE_REQUEST = 0.2
# Code that swallows the exception, such as a bare `except`, gets it again.
SECONDS_BEFORE_RAISING_AGAIN = 0.5
_SOON = 0.02  # seconds


class Stopped(KeyboardInterrupt):
    """The signal ``number`` asked the process to stop."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    def __str__(self) -> str:
        return signal.Signals(self.number).name


class StopRequest:
    """A request to stop by signals, and how long it may be delayed."""

    def __init__(self) -> None:
        self.number: int | None = None  # the first signal that asked
        self.n_asked = 0  # how often; signals in quick succession count once
        self._asked_at = self._signalled_at = -math.inf
        self._patience = 0.0  # seconds; infinite if nothing may be raised
        self._is_waiting = False  # inside `waiting`, with a timer

    @property
    def is_urgent(self) -> bool:
        """Whether a second signal has come, so that optional work should be skipped."""
        return self.n_asked > 1

    def raise_if_asked(self) -> None:
        """Raise `Stopped` if a stop was requested; call it between two pieces of work."""
        if self.number is not None:
            raise Stopped(self.number)

    @contextmanager
    def waiting(self, seconds: float) -> Iterator[None]:
        """Delay a stop in the ``with`` statement by at most ``seconds``, until a second signal.

        After the time-out, `Stopped` is raised, also in place of an error that it has caused.
        """
        before = self._patience, self._is_waiting
        self._patience, self._is_waiting = seconds, True
        try:
            self._raise_if_due()
            yield
        except Exception as error:
            if self.number is None or self._seconds_left() > 0:
                raise
            raise Stopped(self.number) from error
        finally:
            self._patience, self._is_waiting = before
            self._set_timer(self._seconds_left())

    @contextmanager
    def held(self) -> Iterator[None]:
        """Raise no `Stopped` inside the ``with`` statement, except in a nested `waiting`."""
        before, self._patience = self._patience, math.inf
        try:
            yield
        finally:
            self._patience = before
            self._set_timer(self._seconds_left())

    def notice(self, number: int, frame: FrameType | None = None) -> None:
        """Handle a signal: raise `Stopped` unless it is delayed."""
        now = time.monotonic()
        is_another = now - self._signalled_at > SECONDS_OF_ONE_REQUEST
        self._signalled_at = now
        if not is_another:
            return
        self.n_asked += 1
        if self.number is None:
            self.number, self._asked_at = number, now
            _noticed.append(number)
        if self.n_asked > 2:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        self._raise_if_due()

    def _seconds_left(self) -> float:
        """Seconds until `Stopped` is due; infinite without a request, or while it is held."""
        if self.number is None or self._patience == math.inf:
            return math.inf
        return 0.0 if self.is_urgent else self._asked_at + self._patience - time.monotonic()

    def _raise_if_due(self, *_: object) -> None:
        left = self._seconds_left()
        self._set_timer(left if left > 0 else SECONDS_BEFORE_RAISING_AGAIN)
        if left <= 0:
            self.raise_if_asked()

    def _set_timer(self, seconds: float) -> None:
        """Schedule `_raise_if_due`, also during a blocking call; not on Windows."""
        if sys.platform != "win32" and self.number is not None:
            is_timed = self._is_waiting and seconds < math.inf
            if is_timed:
                signal.signal(signal.SIGALRM, self._raise_if_due)
            signal.setitimer(signal.ITIMER_REAL, max(seconds, _SOON) if is_timed else 0.0)


_current: list[StopRequest] = []
_noticed: list[int] = []


def n_stops() -> int:
    """The number of `stops_noticed` blocks in this process that a signal has asked to stop."""
    return len(_noticed)


def current() -> StopRequest:
    """The current stop request; outside `stops_noticed`, one without a signal."""
    if _current and threading.current_thread() is threading.main_thread():
        return _current[-1]
    return StopRequest()


@contextmanager
def stops_noticed() -> Iterator[StopRequest]:
    """Handle stop signals in the ``with`` statement; a nested one shares the outer request.

    A signal that the parent process ignores stays ignored, as for ``nohup`` and a shell's ``&``.
    A signal with a handler keeps it. Outside the main thread, Python delivers no signals.
    """
    if _current or threading.current_thread() is not threading.main_thread():
        yield current()
        return
    request, tell, show = StopRequest(), sys.unraisablehook, sys.excepthook
    before = {number: signal.getsignal(number) for number in SIGNALS}
    _current.append(request)

    def tell_others(unraisable: Any) -> None:
        if not isinstance(unraisable.exc_value, Stopped):
            tell(unraisable)

    def show_others(kind: Any, error: BaseException, trace: Any) -> None:
        if not isinstance(error, Stopped):
            show(kind, error, trace)

    try:
        # Exceptions are lost in callbacks from C code, as in Numba's compiler, and C code that
        # imports NumPy prints them: a timer raises `Stopped` again.
        sys.unraisablehook, sys.excepthook = tell_others, show_others
        for number, handler in before.items():
            if handler in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, request.notice)
        yield request
    finally:
        request._patience = math.inf  # first: a signal could still arrive during the next call
        request._set_timer(math.inf)
        sys.unraisablehook, sys.excepthook = tell, show
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
        _current.clear()


def default_for_signals() -> None:
    """Let signals end the process at once and silently, when its work is done."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            with contextlib.suppress(ValueError):  # outside the main thread
                signal.signal(number, signal.SIG_DFL)


# --- the processes of a SubprocVecEnv -------------------------------------------------------------

SECONDS_FOR_CLOSING = 1.8  # after a stop request; slower processes are killed
SECONDS_TO_END = 1.0  # for a process whose pipe is closed


def shield_workers() -> None:
    """Let new child processes ignore stop signals, because this process still needs them."""
    if sys.platform != "win32" and "forkserver" in multiprocessing.get_all_start_methods():
        from multiprocessing import forkserver, resource_tracker

        # The resource tracker unblocks SIGINT at its start, so it must start first.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def deaths_told(env: VecEnv) -> Iterator[None]:
    """Name the process of a SubprocVecEnv that has ended, instead of the error of its pipe."""
    try:
        yield
    except (EOFError, ConnectionError) as error:
        for number, process in enumerate(getattr(env.unwrapped, "processes", [])):
            process.join(SECONDS_TO_END)
            if process.exitcode is not None:
                how = f"exit code {process.exitcode}"
                if process.exitcode < 0:
                    how = signal.Signals(-process.exitcode).name
                message = f"--vec-env subproc: the process of environment {number} has ended: {how}"
                raise UserError(message) from error
        raise


def close_environments(env: Any) -> None:
    """Close a VecEnv; after a stop request, without waiting for its processes."""
    stop = current()
    try:
        with stop.waiting(SECONDS_FOR_CLOSING):
            env.close()
    except Stopped:
        pass
    except (EOFError, OSError):
        if stop.number is None:
            raise
    end_workers_after_stop()


def end_workers_after_stop() -> None:
    """After a stop request, end environment processes that still run."""
    if current().number is not None:
        for process in multiprocessing.active_children():
            with contextlib.suppress(OSError):
                process.kill()
                process.join()
