"""Runs tasks in child processes, so that a crash does not affect other tasks.

`supervise` runs a function in a child process and waits for it; any executor whose workers can call
`supervise` can launch a study. This module uses a pool of threads, each with one child at a time. A
task gets a new child, or if it may share a process, the previous child of the thread.

On Linux, children are forked from a fork server that has imported the libraries once. Windows
cannot fork, and on macOS a process that has used its libraries should not fork: there each child
is spawned, and imports for some seconds.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import FrameType
from typing import Any

from rl_yardstick.experiments.run_limits import RunLimits
from rl_yardstick.pipeline.stopping import current

RETURNED, RAISED, DIED = "returned", "raised", "died"

# Signals to a whole process group; only the supervisor reacts to them.
LEFT_TO_SUPERVISOR = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def answer_from_child(line: Connection, last_words: Connection) -> None:
    """Do pickled tasks until the pipe closes or a task fails, and send each result.

    ``last_words`` receives the traceback when the process crashes, or is about to be killed.
    """
    leave_signals_to_supervisor()
    if sys.platform != "win32":  # a Windows pipe has no descriptor for a crash report
        faulthandler.enable(last_words.fileno())
        faulthandler.register(signal.SIGUSR1, last_words.fileno())  # prints the traceback
    clean_ups: list[Callable[[], object]] = []
    threading.Thread(target=_end_with_parent, args=(clean_ups,), daemon=True).start()
    kind = RETURNED
    while kind == RETURNED:
        try:
            task = line.recv_bytes()
        except (EOFError, OSError):
            break
        # Unpickled only now, because the imports take seconds in a spawned process.
        try:
            function, args, clean_up = ForkingPickler.loads(task)
            clean_ups[:] = [clean_up]
            answer = function(*args)
        except BaseException as error:  # noqa: BLE001  # the supervisor reports every error
            kind, answer = RAISED, (_words(error), traceback.format_exc())
        with contextlib.suppress(ConnectionError):
            line.send((kind, answer))
    line.close()


def leave_signals_to_supervisor() -> None:
    """Ignore `LEFT_TO_SUPERVISOR` in this process, but not in programs that it starts."""
    for number in LEFT_TO_SUPERVISOR:
        signal.signal(number, _do_nothing)  # not SIG_IGN, which child programs inherit
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_SUPERVISOR)


def _do_nothing(number: int, frame: FrameType | None) -> None:
    """Ignore a signal."""


def _words(error: BaseException) -> str:
    """The message in one line; for exceptions that end a program, with their type."""
    kind, message = type(error).__name__, " ".join(str(error).split())
    if isinstance(error, Exception):
        return message or kind
    return f"{kind}: {message}" if message else kind


def _end_with_parent(clean_ups: list[Callable[[], object]]) -> None:
    """When the supervisor dies, clean up and exit."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    with contextlib.suppress(OSError):
        for clean_up in clean_ups:
            clean_up()
    os._exit(1)


# --- The server that children are forked from.

PRELOADED = ["rl_yardstick.experiments.fork_server_imports"]

# One thread per process: small networks are slower with more, and runs are parallel.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

START_METHOD = "spawn" if sys.platform in ("win32", "darwin") else "forkserver"
# Set only for the server, which removes it again.
WARM_UPS = "YARDSTICK_WARM_UPS"
OUR_OWN = "yardstick"

_log = logging.getLogger(__name__)
context: Any = multiprocessing.get_context(START_METHOD)


def start_server(warm_ups: str = "[]") -> None:
    """Start the fork server in the background, and allow new children after `stop_all`.

    The server compiles ``warm_ups`` once for all runs, see `experiments.run_in_child.warm_ups`.
    """
    _stopping.clear()
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    # Python would search the current folder first, and could import a user's module there instead
    # of one of this project or of Python.
    os.environ.setdefault("PYTHONSAFEPATH", OUR_OWN)
    paths = [str(Path(__file__).resolve().parents[2])]
    paths += os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, dict.fromkeys(paths)))
    if context.get_start_method() == "forkserver":
        os.environ[WARM_UPS] = warm_ups
        context.set_forkserver_preload(PRELOADED)
        _ensure_fork_server()


def _ensure_fork_server() -> None:
    """Start the fork server if it does not run, shielded from signals to the process group."""
    if sys.platform != "win32":
        from multiprocessing import forkserver, resource_tracker

        # The resource tracker unblocks SIGINT at its start, so it must start first.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, LEFT_TO_SUPERVISOR)
        try:
            pid = server_pid()
            forkserver.ensure_running()
            if pid is not None and server_pid() != pid:
                _log.warning("the process that forks runs was killed; it is started again")
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def server_pid() -> int | None:
    """The process number of the fork server, or None."""
    server = getattr(sys.modules.get("multiprocessing.forkserver"), "_forkserver", None)
    pid = getattr(server, "_forkserver_pid", None)
    return pid if isinstance(pid, int) else None


def end_server() -> None:
    """Kill the fork server."""
    if sys.platform != "win32":
        _send(server_pid(), signal.SIGKILL)


def serve_anew() -> None:
    """Replace the fork server by one that has imported no module of the user."""
    os.environ[WARM_UPS] = "[]"
    end_server()  # the next child starts another


def _send(pid: int | None, number: int) -> None:
    """Send a signal to a process, if it still exists."""
    if sys.platform != "win32" and pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)  # noqa: TID251  # not on Windows


# --- The supervisor.

SECONDS_TO_START = 0.3  # for a fork, once the server has imported
# The time for a process to print its traceback before it is killed.
SECONDS_FOR_LAST_WORDS = 0.3
NO_LIMITS = RunLimits()

_children: set[_Child] = set()
_idle: dict[int, _Child] = {}  # by thread
_lock = threading.Lock()
_stopping = threading.Event()


class TaskFailedError(Exception):
    """The function raised an exception, or exceeded a limit."""

    def __init__(self, message: str, details: str) -> None:
        super().__init__(message)
        self.details = details  # the traceback, or other details


class TaskDiedError(TaskFailedError):
    """The process of the function died at each try."""


class StoppedError(Exception):
    """The task was stopped."""


def supervise(
    function: Callable[..., Any],
    *args: Any,
    clean_up: Callable[[], object],
    tries: int = 2,
    limits: RunLimits = NO_LIMITS,
    shares_process: bool = False,
) -> Any:
    """Call ``function`` in a child process; retry if the process dies without an answer.

    ``clean_up`` is called here after each try, and in the child if this process dies first. With
    ``shares_process``, the task may use a process that earlier and later tasks share, unless
    memory is limited, because the limit holds for a process. Retries and tasks after a failure
    get a new process.

    Raises:
        TaskFailedError: if it raised an exception or exceeded a limit; there is no retry.
        TaskDiedError: if its process died at each try.
        StoppedError: if `stop_all` ended it.
    """
    task = bytes(ForkingPickler.dumps((function, args, clean_up)))
    shares_process = shares_process and limits.memory is None
    for _ in range(tries):
        kind, answer = _attempt(task, limits, shares_process)
        clean_up()
        if _stopping.is_set():
            raise StoppedError
        if kind == RETURNED:
            return answer
        if kind == RAISED:
            raise TaskFailedError(*answer)
    how, last_words = answer
    details = f"{last_words}{how}, {tries} times\n"
    raise TaskDiedError(f"its process died {tries} times ({how})", details)


def do_aside(function: Callable[..., Any], *args: Any) -> Any:
    """Call a function in a child of the fork server, which has imported the libraries.

    Importing them here too would take more than a second and 200 MB. Without a server, or if the
    child fails, the function is called in this process, which then raises its exceptions.
    """
    if server_pid() is not None and not _stopping.is_set():
        with contextlib.suppress(TaskFailedError, OSError, EOFError, RuntimeError):
            return supervise(function, *args, clean_up=bool)  # nothing to clean up
    return function(*args)


class _Child:
    """A child process with its pipes."""

    def __init__(self) -> None:
        self.line, line = context.Pipe()  # for tasks and answers
        self.last_words, writer = context.Pipe(duplex=False)
        theirs = (line, writer)
        self.process = context.Process(target=answer_from_child, args=theirs, daemon=True)
        try:
            with _lock:
                if _stopping.is_set():
                    raise StoppedError
                _start(self.process)
                _children.add(self)
        except BaseException:
            self._close()
            raise
        finally:
            for connection in theirs:
                connection.close()

    def attempt(self, task: bytes, limits: RunLimits) -> tuple[str, Any]:
        """Do a task: returns `RETURNED` and value; `RAISED`, reason and details; or `DIED` and how.

        A child that exceeds a limit is killed. Only a child that has returned a value can do
        another task; otherwise it has ended.
        """
        with contextlib.suppress(OSError):  # it is dead, which is noticed below
            self.line.send_bytes(task)
        if reason := self._exceeded(limits):
            self.process.join()
            return RAISED, (reason, f"{self._read_last_words()}{reason}\n")
        try:
            kind, answer = self.line.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return DIED, (how, self._read_last_words())
        if kind == RAISED:
            self.process.join()
        return kind, answer

    def _exceeded(self, limits: RunLimits) -> str:
        """Wait for an answer or the child's end; returns the exceeded limit, if any."""
        pid, started = self.process.pid, time.monotonic()
        while not self.line.poll(limits.pause):
            reason = limits.exceeded(pid or 0, time.monotonic() - started)
            if reason and not self.line.poll(0):
                if sys.platform != "win32":
                    _send(pid, signal.SIGUSR1)  # prints the traceback
                    self.line.poll(SECONDS_FOR_LAST_WORDS)
                self.kill()
                return reason
        return ""

    def _read_last_words(self) -> str:
        text = b""
        if sys.platform != "win32":
            with contextlib.suppress(EOFError, OSError):
                number = self.last_words.fileno()
                while self.last_words.poll(0) and (piece := os.read(number, 1 << 16)):
                    text += piece
        # Without Python's long list of extension modules.
        lines = text.decode(errors="replace").splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith("Extension modules: "))

    def kill(self) -> None:
        """Kill the child, even if the server that forked it is dead."""
        if sys.platform == "win32":
            self.process.kill()
        else:  # `Process.kill` considers a child dead if its fork server is
            _send(self.process.pid, signal.SIGKILL)

    def end(self) -> None:
        """Wait for the end of the child, which comes soon without further tasks."""
        self._close()
        self.process.join()
        with _lock:
            _children.discard(self)

    def _close(self) -> None:
        self.line.close()
        self.last_words.close()


def _attempt(task: bytes, limits: RunLimits, shares_process: bool) -> tuple[str, Any]:
    """Do the task in this thread's child, or in a new one; see `_Child.attempt`."""
    thread = threading.get_ident()
    child = _idle.pop(thread, None)
    if child is not None and not (shares_process and child.process.is_alive()):
        child.end()
        child = None
    if child is None:
        child = _Child()
    kind = DIED
    try:
        kind, answer = child.attempt(task, limits)
    except BaseException:
        child.kill()
        raise
    finally:
        if shares_process and kind == RETURNED:
            _idle[thread] = child
        else:
            child.end()
    return kind, answer


def _end_idle() -> None:
    """End the children that wait for tasks."""
    while _idle:
        _idle.popitem()[1].end()


def _start(child: BaseProcess) -> None:
    """Start a child; if the fork server was killed, start a new one first."""
    if context.get_start_method() != "forkserver":
        child.start()
        return
    for _ in range(8):
        _ensure_fork_server()
        with contextlib.suppress(EOFError, OSError):
            child.start()
            return
        if _stopping.wait(0.2):  # a killed server stops answering before it ends
            raise StoppedError
    child.start()


@contextlib.contextmanager
def local_executor(n_workers: int) -> Iterator[ThreadPoolExecutor]:
    """A pool with one supervisor thread per parallel process; early exit ends all children."""
    start_server()
    executor = ThreadPoolExecutor(n_workers)
    try:
        yield executor
    except BaseException:
        with current().held():  # a second Ctrl-C must wait only briefly
            stop_all()
            executor.shutdown(cancel_futures=True)
            _end_idle()
        raise
    executor.shutdown(cancel_futures=True)
    _end_idle()


def stop_all() -> None:
    """End all children, and refuse new ones."""
    _stopping.set()
    if not _lock.acquire(timeout=SECONDS_TO_START):
        end_server()  # a child is starting while the server still imports
        _lock.acquire()
    try:
        for child in _children:
            child.kill()
    finally:
        _lock.release()
