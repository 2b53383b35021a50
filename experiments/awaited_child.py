"""The end of a child process, as its supervisor sees it: an answer, a crash, or a limit."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from experiments.run_limits import RunLimits

# How long a process that is to be ended has to say where it is.
SECONDS_FOR_LAST_WORDS = 0.3

RETURNED, RAISED, DIED = "returned", "raised", "died"


def awaited(
    child: BaseProcess, receiver: Connection, last_words: Connection, limits: RunLimits
) -> tuple[str, Any]:
    """Wait for the answer of a child, and end it where it exceeds a limit.

    One that has returned a value may be given another task; any other has ended.

    Args:
        child: has been started with `experiments.task_in_child.answer_from_child`.
        receiver: where its answer comes from.
        last_words: where the traceback of a crash comes from.
        limits: what it may take.

    Returns:
        `RETURNED` and the value; `RAISED` and the reason with its details; or `DIED`, how, and the
        traceback as far as there is one.
    """
    reason = _wait(child, receiver, limits)
    try:
        kind, answer = (RAISED, None) if reason else receiver.recv()
    except (EOFError, OSError):
        kind, answer = DIED, None
    if kind == RETURNED:
        return kind, answer
    child.join()
    if reason:
        answer = (reason, f"{_read(last_words)}{reason}\n")
    elif kind == DIED:
        code = child.exitcode or 0
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        answer = (how, _read(last_words))
    return kind, answer


def _wait(child: BaseProcess, receiver: Connection, limits: RunLimits) -> str:
    """Wait until there is an answer, or none will come; or end what exceeds a limit, and say so."""
    started = time.monotonic()
    while not receiver.poll(limits.pause):
        reason = limits.exceeded(child.pid or 0, time.monotonic() - started)
        if reason and not receiver.poll(0):
            if sys.platform != "win32":
                _send(child, signal.SIGUSR1)  # it says where it is
                receiver.poll(SECONDS_FOR_LAST_WORDS)
            kill(child)
            return reason
    return ""


def _read(last_words: Connection) -> str:
    text = b""
    if sys.platform != "win32":
        with contextlib.suppress(EOFError, OSError):
            while last_words.poll(0) and (piece := os.read(last_words.fileno(), 1 << 16)):
                text += piece
    # Python also lists all modules in C, which is a page of them and tells nothing.
    lines = text.decode(errors="replace").splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith("Extension modules: "))


def kill(child: BaseProcess) -> None:
    """End a child at once, also where the server that forked it has been killed."""
    if sys.platform == "win32":
        child.kill()
    else:
        _send(child, signal.SIGKILL)


def _send(child: BaseProcess, number: int) -> None:
    # `child.kill` takes a child for dead when the process that forked it is.
    if sys.platform != "win32" and child.pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child.pid, number)
