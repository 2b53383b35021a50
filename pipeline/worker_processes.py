"""The processes of a SubprocVecEnv, when somebody asks the training to stop.

Ctrl-C in a terminal, a closed terminal and many a cluster signal to all processes at once. Workers
that ended by themselves would take away the environments that the training still needs.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import sys
from typing import Any

from pipeline.stopping import SIGNALS, Stopped, current

# After a stop was asked for: what takes longer is ended.
SECONDS_FOR_CLOSING = 1.8


def shield_workers() -> None:
    """Let the processes that are started from now on leave signals to this one."""
    if sys.platform != "win32" and "forkserver" in multiprocessing.get_all_start_methods():
        from multiprocessing import forkserver, resource_tracker

        # It lets SIGINT through again after its own start, so that has to come first.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def close_environments(env: Any) -> None:
    """Close a VecEnv; where a stop was asked for, do not wait for what its processes still do."""
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
    """End the processes of environments that are still there, if a stop was asked for."""
    if current().number is not None:
        for process in multiprocessing.active_children():
            with contextlib.suppress(OSError):
                process.kill()
                process.join()
