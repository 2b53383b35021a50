"""Tasks in processes of their own, so that one that dies takes nothing else with it.

`supervise` runs a function in a fresh child process and waits for it; any executor whose workers
can call it launches a study. Here that is a pool of threads, each with one child at a time. On
Linux the children are forked from a server that has imported the heavy libraries once. Windows
cannot fork, and on macOS a process that has used its libraries should not: there each child begins
anew, and imports for some seconds.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

PRELOADED = ["experiments.run_in_child", "experiments.fork_server_imports"]

# One thread in each process: small networks are slower with more, and runs go side by side.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

START_METHOD = "spawn" if sys.platform in ("win32", "darwin") else "forkserver"
# Set for the server alone, which takes it away again.
WARM_UPS = "YARDSTICK_WARM_UPS"
OUR_OWN = "yardstick"

_context: Any = multiprocessing.get_context(START_METHOD)
_children: set[BaseProcess] = set()
_lock = threading.Lock()
_stopping = threading.Event()


class TaskFailedError(Exception):
    """The function raised an exception, or its process died each time.

    Attributes:
        details: the traceback, or what is known.
    """

    def __init__(self, message: str, details: str) -> None:
        super().__init__(message)
        self.details = details


class StoppedError(Exception):
    """The task was stopped."""


def supervise(
    function: Callable[..., Any],
    *args: Any,
    clean_up: Callable[[], object],
    tries: int = 2,
) -> Any:
    """Call ``function`` in a child process; again if the process dies without an answer.

    Args:
        function: of a module that the child can import.
        args: what to call it with.
        clean_up: called here after each try, and in the child if this process dies before it.
        tries: how often to begin.

    Returns:
        What the function returns.

    Raises:
        TaskFailedError: if it raised an exception, which is not tried again, or died each time.
        StoppedError: if `stop_all` ended it.
    """
    task = bytes(ForkingPickler.dumps((function, args, clean_up)))
    for _ in range(tries):
        receiver, sender = _context.Pipe(duplex=False)
        child = _context.Process(target=_answer_from_child, args=(sender, task), daemon=True)
        with _started(child):
            sender.close()
            try:
                kind, answer = receiver.recv()
            except EOFError:
                kind, answer = "died", None
            finally:
                receiver.close()
            child.join()
            clean_up()
        if _stopping.is_set():
            raise StoppedError
        if kind == "returned":
            return answer
        if kind == "raised":
            raise TaskFailedError(*answer)
    code = child.exitcode or 0
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    raise TaskFailedError(f"its process died {tries} times ({how})", f"{how}, {tries} times")


@contextlib.contextmanager
def _started(child: BaseProcess) -> Iterator[None]:
    with _lock:
        if _stopping.is_set():
            raise StoppedError
        child.start()
        _children.add(child)
    try:
        yield
    finally:
        with _lock:
            _children.discard(child)


@contextlib.contextmanager
def local_executor(n_workers: int) -> Iterator[ThreadPoolExecutor]:
    """As many supervisors as ``n_workers``; their children are ended when the block is left early.

    Args:
        n_workers: processes that work at once.
    """
    start_server()
    _stopping.clear()
    executor = ThreadPoolExecutor(n_workers)
    try:
        yield executor
    except BaseException:
        stop_all()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def start_server(warm_ups: str = "[]") -> None:
    """Start what children begin from, in the background: start it early to have it sooner.

    Args:
        warm_ups: what it is to compile once for all runs, see `experiments.warm_ups`.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    # Python would look in the folder where the command is typed before everywhere else, and take a
    # module of the user's that lies there for one of ours, or of its own.
    os.environ.setdefault("PYTHONSAFEPATH", OUR_OWN)
    paths = [str(Path(__file__).resolve().parents[1])]
    paths += os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, dict.fromkeys(paths)))
    if _context.get_start_method() == "forkserver":
        _start_fork_server(warm_ups)


def _start_fork_server(warm_ups: str) -> None:
    """Start the process that children are forked from, which ignores Ctrl-C while it imports."""
    if sys.platform != "win32":
        from multiprocessing import forkserver, resource_tracker

        os.environ[WARM_UPS] = warm_ups
        _context.set_forkserver_preload(PRELOADED)
        # It lets SIGINT through again after its own start, so that has to come first.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def stop_all() -> None:
    """End all children, and let none be started any more."""
    with _lock:
        _stopping.set()
        for child in _children:
            child.kill()


def _answer_from_child(sender: Connection, task: bytes) -> None:
    # Ctrl-C reaches the whole group of processes; the supervisor decides what it means. Only then
    # is the task unpacked: in a process that begins anew, its imports take seconds.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        function, args, clean_up = ForkingPickler.loads(task)
        threading.Thread(target=_end_with_parent, args=(clean_up,), daemon=True).start()
        answer = ("returned", function(*args))
    except Exception as error:  # noqa: BLE001  # whatever it is, the supervisor is told
        message = " ".join(str(error).split()) or type(error).__name__
        answer = ("raised", (message, traceback.format_exc()))
    with contextlib.suppress(BrokenPipeError):
        sender.send(answer)
    sender.close()


def _end_with_parent(clean_up: Callable[[], object]) -> None:
    """Leave nothing behind when the supervisor is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    with contextlib.suppress(OSError):
        clean_up()
    os._exit(1)
