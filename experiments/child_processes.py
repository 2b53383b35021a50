"""Tasks in processes of their own, so that one that dies takes nothing else with it.

`supervise` runs a function in a child process and waits for it; any executor whose workers
can call it launches a study. Here that is a pool of threads, each with one child at a time. A child
is a fresh one, or for tasks that may share a process, the one that the thread had before. What it
begins from is in `fork_server`.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

from experiments import fork_server
from experiments.awaited_child import DIED, RAISED, RETURNED, awaited, kill
from experiments.run_limits import RunLimits
from experiments.task_in_child import answer_from_child
from pipeline.stopping import current

SECONDS_TO_START = 0.3  # that a server takes to fork, once it has imported
NO_LIMITS = RunLimits()

_children: set[BaseProcess] = set()
_idle: dict[int, _Child] = {}  # by thread
_lock = threading.Lock()
_stopping = threading.Event()


class TaskFailedError(Exception):
    """The function raised an exception, or exceeded a limit.

    Attributes:
        details: the traceback, or what is known.
    """

    def __init__(self, message: str, details: str) -> None:
        super().__init__(message)
        self.details = details


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

    A task that may share a process is done where others were done before, and leaves it to others;
    not so where memory is limited, which is that of the process. After one that fails, and for
    another try, there is a fresh process.

    Args:
        function: of a module that the child can import.
        args: what to call it with.
        clean_up: called here after each try, and in the child if this process dies before it.
        tries: how often to begin.
        limits: what each try may take.
        shares_process: whether it may share one with other such tasks.

    Returns:
        What the function returns.

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
    if fork_server.server_pid() is not None and not _stopping.is_set():
        with contextlib.suppress(TaskFailedError, OSError, EOFError, RuntimeError):
            return supervise(function, *args, clean_up=_nothing)
    return function(*args)


def _nothing() -> None:
    """Clean up after a task that leaves nothing."""


class _Child:
    """A child process, and what goes to it and comes from it."""

    def __init__(self) -> None:
        context = fork_server.context
        self.answers, sender = context.Pipe(duplex=False)
        self.last_words, writer = context.Pipe(duplex=False)
        given, self.tasks = context.Pipe(duplex=False)
        theirs = (sender, writer, given)
        self.process = context.Process(target=answer_from_child, args=theirs, daemon=True)
        try:
            with _lock:
                if _stopping.is_set():
                    raise StoppedError
                _start(self.process)
                _children.add(self.process)
        except BaseException:
            self._close()
            raise
        finally:
            for connection in theirs:
                connection.close()

    def attempt(self, task: bytes, limits: RunLimits, is_last: bool) -> tuple[str, Any]:
        """What becomes of a task, see `awaited`."""
        with contextlib.suppress(OSError):  # it is gone, as `awaited` will find
            self.tasks.send_bytes(task)
        if is_last:
            self.tasks.close()
        return awaited(self.process, self.answers, self.last_words, limits)

    def end(self) -> None:
        """Wait until it is gone, which it is soon, since nothing is left to do."""
        self.tasks.close()
        self.process.join()
        with _lock:
            _children.discard(self.process)
        self._close()

    def _close(self) -> None:
        for connection in (self.answers, self.last_words, self.tasks):
            connection.close()


def _attempt(task: bytes, limits: RunLimits, shares_process: bool) -> tuple[str, Any]:
    """What became of the task in this thread's child, or in a fresh one; see `awaited`."""
    thread = threading.get_ident()
    child = _idle.pop(thread, None)
    if child is not None and not (shares_process and child.process.is_alive()):
        child.end()
        child = None
    if child is None:
        child = _Child()
    kind = DIED
    try:
        kind, answer = child.attempt(task, limits, is_last=not shares_process)
    except BaseException:
        kill(child.process)
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
    if fork_server.context.get_start_method() != "forkserver":
        child.start()
        return
    for _ in range(8):
        fork_server.ensure_fork_server()
        with contextlib.suppress(EOFError, OSError):
            child.start()
            return
        if _stopping.wait(0.2):  # a server that was killed is deaf some time before it is gone
            raise StoppedError
    child.start()


@contextlib.contextmanager
def local_executor(n_workers: int) -> Iterator[ThreadPoolExecutor]:
    """As many supervisors as ``n_workers``; their children are ended when the block is left early.

    Args:
        n_workers: processes that work at once.
    """
    be_ready()
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


def be_ready(warm_ups: str = "[]") -> None:
    """Start what children begin from, and let them be started, also after `stop_all`."""
    fork_server.start_server(warm_ups)
    _stopping.clear()


def stop_all() -> None:
    """End all children, and let none be started any more."""
    _stopping.set()
    if not _lock.acquire(timeout=SECONDS_TO_START):
        fork_server.end_server()  # one is being started, by a server that is still importing
        _lock.acquire()
    try:
        for child in _children:
            kill(child)
    finally:
        _lock.release()
