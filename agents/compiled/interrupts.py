"""Ctrl-C, and what else ends a process, at a moment that leaves nothing half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], object]

# Windows has no SIGHUP.
_SIGNALS = [getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP")]


class _Hold:
    """What the handler of the first signal raised, until it is time for it."""

    def __init__(self) -> None:
        self.n_signals = 0
        self.waiting: BaseException | None = None

    def around(self, handler: Handler) -> Handler:
        """The handler, of which the first exception waits."""

        def hold(number: int, frame: FrameType | None) -> None:
            self.n_signals += 1
            try:
                handler(number, frame)
            except BaseException as error:
                if self.n_signals > 1:
                    raise
                self.waiting = error

        return hold


@contextmanager
def interrupts_held() -> Iterator[Callable[[], bool]]:
    """Let what the first signal raises wait until the ``with`` statement is left; a second not.

    That is KeyboardInterrupt on Ctrl-C, and whatever the handlers raise that a program has set for
    SIGINT, SIGTERM and SIGHUP; they are called at once. Outside the main thread, where Python
    delivers no signals, nothing is held.

    Yields:
        A function that tells whether an exception is waiting.
    """
    hold = _Hold()
    try:
        with ExitStack() as restoring:
            if threading.current_thread() is threading.main_thread():
                for number in filter(None, _SIGNALS):
                    handler = signal.getsignal(number)
                    if callable(handler):
                        restoring.callback(signal.signal, number, handler)
                        signal.signal(number, hold.around(handler))
            yield lambda: hold.waiting is not None
    finally:
        if hold.waiting is not None:
            raise hold.waiting
