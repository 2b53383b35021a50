"""What children begin from: on Linux a server that is forked, and has imported the libraries once.

Windows cannot fork, and on macOS a process that has used its libraries should not: there each child
begins anew, and imports for some seconds.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
from pathlib import Path
from typing import Any

from experiments.task_in_child import LEFT_TO_SUPERVISOR

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
    if context.get_start_method() == "forkserver":
        _start_fork_server(warm_ups)


def _start_fork_server(warm_ups: str) -> None:
    """Start the process that children are forked from."""
    os.environ[WARM_UPS] = warm_ups
    context.set_forkserver_preload(PRELOADED)
    ensure_fork_server()


def ensure_fork_server() -> None:
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
    pid = server_pid()
    if sys.platform != "win32" and pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
