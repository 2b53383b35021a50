"""The processes of a SubprocVecEnv, when one ends or somebody asks the training to stop.

Ctrl-C in a terminal, a closed terminal and many a cluster signal to all processes at once. Workers
that ended by themselves would take away the environments that the training still needs.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError
from pipeline.stopping import SIGNALS, Stopped, current

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# After a stop was asked for: what takes longer is ended.
SECONDS_FOR_CLOSING = 1.8
# For a process whose pipe is closed.
SECONDS_TO_END = 1.0


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


@contextmanager
def deaths_told(env: VecEnv) -> Iterator[None]:
    """Say which process of a SubprocVecEnv has ended, where one has.

    Raises:
        UserError: naming it, in the place of what its pipe raises.
    """
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
