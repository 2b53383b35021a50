"""What a child process of `child_processes` does: tasks, and an answer to each."""

from __future__ import annotations

import contextlib
import faulthandler
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from types import FrameType
from typing import Any

# What reaches a whole group of processes at once; the supervisor decides what it means.
LEFT_TO_SUPERVISOR = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def answer_from_child(sender: Connection, last_words: Connection, tasks: Connection) -> None:
    """Do tasks until there are none any more, or one fails, and send what came of each.

    Args:
        sender: takes ``("returned", value)`` or ``("raised", (message, traceback))``.
        last_words: takes the traceback where the process crashes, or is about to be ended.
        tasks: where they come from: function, arguments, and what to call if the supervisor dies
            first, pickled.
    """
    leave_signals_to_supervisor()
    _say_last_words(last_words)
    clean_up = _CleanUp()
    threading.Thread(target=_end_with_parent, args=(clean_up,), daemon=True).start()
    kind = "returned"
    while kind == "returned":
        try:
            task = tasks.recv_bytes()
        except (EOFError, OSError):
            break
        kind, answer = _done(task, clean_up)
        with contextlib.suppress(BrokenPipeError):
            sender.send((kind, answer))
    sender.close()


class _CleanUp:
    """What to call if the supervisor dies: that of the task under way."""

    def __init__(self) -> None:
        self.of_task: Callable[[], object] | None = None

    def __call__(self) -> None:
        if self.of_task is not None:
            self.of_task()


def _done(task: bytes, clean_up: _CleanUp) -> tuple[str, Any]:
    # Only now is the task unpacked: in a process that begins anew, its imports take seconds.
    try:
        function, args, clean_up.of_task = ForkingPickler.loads(task)
        return "returned", function(*args)
    except BaseException as error:  # noqa: BLE001  # whatever it is, the supervisor is told
        return "raised", (_words(error), traceback.format_exc())


def leave_signals_to_supervisor() -> None:
    """Do nothing when such a signal comes; programs that this process starts get it as usual."""
    for number in LEFT_TO_SUPERVISOR:
        signal.signal(number, _do_nothing)  # and not SIG_IGN, which they would inherit
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_SUPERVISOR)


def _do_nothing(number: int, frame: FrameType | None) -> None:
    """Handle a signal."""


def _words(error: BaseException) -> str:
    """The message in one line; with the kind of what ends a program, where no mistake is meant."""
    kind, message = type(error).__name__, " ".join(str(error).split())
    if isinstance(error, Exception):
        return message or kind
    return f"{kind}: {message}" if message else kind


def _say_last_words(last_words: Connection) -> None:
    """Let a crash leave its traceback; and SIGUSR1, which the supervisor sends to learn it."""
    if sys.platform != "win32":  # there a pipe has no number that a crash could write to
        faulthandler.enable(last_words.fileno())
        faulthandler.register(signal.SIGUSR1, last_words.fileno())


def _end_with_parent(clean_up: Callable[[], object]) -> None:
    """Leave nothing behind when the supervisor is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    with contextlib.suppress(OSError):
        clean_up()
    os._exit(1)
