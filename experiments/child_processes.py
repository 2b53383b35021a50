"""Tasks in processes of their own, so that one that dies takes nothing else with it.

`supervise` runs a function in a child process and waits for it; any executor whose workers
can call it launches a study. Here that is a pool of threads, each with one child at a time. A child
is a fresh one, or for tasks that may share a process, the one that the thread had before.

Children begin on Linux from a server that is forked, and has imported the libraries once. Windows
cannot fork, and on macOS a process that has used its libraries should not: there each child begins
anew, and imports for some seconds.
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

from experiments.run_limits import RunLimits
from pipeline.stopping import current

RETURNED, RAISED, DIED = "returned", "raised", "died"

# What reaches a whole group of processes at once; the supervisor decides what it means.
LEFT_TO_SUPERVISOR = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def answer_from_child(line: Connection, last_words: Connection) -> None:
    """Do pickled tasks until there are none any more, or one fails, and send what came of each.

    ``last_words`` takes the traceback where the process crashes, or is about to be ended.
    """
    leave_signals_to_supervisor()
    if sys.platform != "win32":  # there a pipe has no number that a crash could write to
        faulthandler.enable(last_words.fileno())
        faulthandler.register(signal.SIGUSR1, last_words.fileno())  # sent to learn where it is
    clean_ups: list[Callable[[], object]] = []
    threading.Thread(target=_end_with_parent, args=(clean_ups,), daemon=True).start()
    kind = RETURNED
    while kind == RETURNED:
        try:
            task = line.recv_bytes()
        except (EOFError, OSError):
            break
        # Only now is the task unpacked: in a process that begins anew, its imports take seconds.
        try:
            function, args, clean_up = ForkingPickler.loads(task)
            clean_ups[:] = [clean_up]
            answer = function(*args)
        except BaseException as error:  # noqa: BLE001  # whatever it is, the supervisor is told
            kind, answer = RAISED, (_words(error), traceback.format_exc())
        with contextlib.suppress(ConnectionError):
            line.send((kind, answer))
    line.close()


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


def _end_with_parent(clean_ups: list[Callable[[], object]]) -> None:
    """Leave nothing behind when the supervisor is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    with contextlib.suppress(OSError):
        for clean_up in clean_ups:
            clean_up()
    os._exit(1)


# --- The server that children are forked from.

PRELOADED = ["experiments.fork_server_imports"]

# One thread in each process: small networks are slower with more, and runs go side by side.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

START_METHOD = "spawn" if sys.platform in ("win32", "darwin") else "forkserver"
# Set for the server alone, which takes it away again.
WARM_UPS = "YARDSTICK_WARM_UPS"
OUR_OWN = "yardstick"

_log = logging.getLogger(__name__)
context: Any = multiprocessing.get_context(START_METHOD)


def start_server(warm_ups: str = "[]") -> None:
    """Start what children begin from, in the background, and let them be started after `stop_all`.

    It compiles ``warm_ups`` once for all runs, see `experiments.run_in_child.warm_ups`.
    """
    _stopping.clear()
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    # Python would look in the folder where the command is typed before everywhere else, and take a
    # module of the user's that lies there for one of ours, or of its own.
    os.environ.setdefault("PYTHONSAFEPATH", OUR_OWN)
    paths = [str(Path(__file__).resolve().parents[1])]
    paths += os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, dict.fromkeys(paths)))
    if context.get_start_method() == "forkserver":
        os.environ[WARM_UPS] = warm_ups
        context.set_forkserver_preload(PRELOADED)
        _ensure_fork_server()


def _ensure_fork_server() -> None:
    """Start it where it is not there; signals to all processes at once leave it as it is."""
    if sys.platform != "win32":
        from multiprocessing import forkserver, resource_tracker

        # It lets SIGINT through again after its own start, so that has to come first.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, LEFT_TO_SUPERVISOR)
        try:
            pid = server_pid()
            forkserver.ensure_running()
            if pid is not None and server_pid() != pid:
                _log.warning("the process that runs are forked from was killed; it is started anew")
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def server_pid() -> int | None:
    """The process that children are forked from, where there is one."""
    server = getattr(sys.modules.get("multiprocessing.forkserver"), "_forkserver", None)
    pid = getattr(server, "_forkserver_pid", None)
    return pid if isinstance(pid, int) else None


def end_server() -> None:
    """End the process that children are forked from, whatever it is at."""
    if sys.platform != "win32":
        _send(server_pid(), signal.SIGKILL)


def _send(pid: int | None, number: int) -> None:
    """Send a signal to a process, if it is still there."""
    if sys.platform != "win32" and pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


# --- The supervisor.

SECONDS_TO_START = 0.3  # that a server takes to fork, once it has imported
# How long a process that is to be ended has to say where it is.
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
        self.details = details  # the traceback, or what is known


class TaskDiedError(TaskFailedError):
    """The process of the function died each time."""


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
    """Call ``function`` in a child process; again if the process dies without an answer.

    ``clean_up`` is called here after each try, and in the child if this process dies before it.
    With ``shares_process`` the task is done where others were done before, and leaves the process
    to others; not so where memory is limited, which is that of the process. After a failure, and
    for another try, there is a fresh process.

    Raises:
        TaskFailedError: if it raised an exception or exceeded a limit, which is not tried again.
        TaskDiedError: if its process died each time.
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
    """Call a function in a child of the fork server, which has the libraries, where there is one.

    Importing them here too would take more than a second and 200 MB. Without a server, and where
    the child fails, it is called here, so that what it raises is raised from here.
    """
    if server_pid() is not None and not _stopping.is_set():
        with contextlib.suppress(TaskFailedError, OSError, EOFError, RuntimeError):
            return supervise(function, *args, clean_up=bool)  # there is nothing to clean up
    return function(*args)


class _Child:
    """A child process, and what goes to it and comes from it."""

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
        """Have a task done: `RETURNED` and value; `RAISED`, reason and details; or `DIED` and how.

        The child is ended where it exceeds a limit. One that has returned a value may be given
        another task; any other has ended.
        """
        with contextlib.suppress(OSError):  # it is gone, as is found below
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
        """Wait until there is an answer, or none will come; which limit ended it before."""
        pid, started = self.process.pid, time.monotonic()
        while not self.line.poll(limits.pause):
            reason = limits.exceeded(pid or 0, time.monotonic() - started)
            if reason and not self.line.poll(0):
                if sys.platform != "win32":
                    _send(pid, signal.SIGUSR1)  # it says where it is
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
        # Python also lists all modules in C, which is a page of them and tells nothing.
        lines = text.decode(errors="replace").splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith("Extension modules: "))

    def kill(self) -> None:
        """End it at once, also where the server that forked it has been killed."""
        if sys.platform == "win32":
            self.process.kill()
        else:  # `Process.kill` takes a child for dead when the process that forked it is
            _send(self.process.pid, signal.SIGKILL)

    def end(self) -> None:
        """Wait until it is gone, which it is soon, since nothing is left to do."""
        self._close()
        self.process.join()
        with _lock:
            _children.discard(self)

    def _close(self) -> None:
        self.line.close()
        self.last_words.close()


def _attempt(task: bytes, limits: RunLimits, shares_process: bool) -> tuple[str, Any]:
    """What became of the task in this thread's child, or in a fresh one; see `_Child.attempt`."""
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
    """End the children that wait for more."""
    while _idle:
        _idle.popitem()[1].end()


def _start(child: BaseProcess) -> None:
    """Start a child; from a new server, where somebody has killed the one there was."""
    if context.get_start_method() != "forkserver":
        child.start()
        return
    for _ in range(8):
        _ensure_fork_server()
        with contextlib.suppress(EOFError, OSError):
            child.start()
            return
        if _stopping.wait(0.2):  # a server that was killed is deaf some time before it is gone
            raise StoppedError
    child.start()


@contextlib.contextmanager
def local_executor(n_workers: int) -> Iterator[ThreadPoolExecutor]:
    """As many supervisors as processes that work at once; left early, it ends their children."""
    start_server()
    executor = ThreadPoolExecutor(n_workers)
    try:
        yield executor
    except BaseException:
        with current().held():  # a second Ctrl-C finds it as short as it can be
            stop_all()
            executor.shutdown(cancel_futures=True)
            _end_idle()
        raise
    executor.shutdown(cancel_futures=True)
    _end_idle()


def stop_all() -> None:
    """End all children, and let none be started any more."""
    _stopping.set()
    if not _lock.acquire(timeout=SECONDS_TO_START):
        end_server()  # one is being started, by a server that is still importing
        _lock.acquire()
    try:
        for child in _children:
            child.kill()
    finally:
        _lock.release()
