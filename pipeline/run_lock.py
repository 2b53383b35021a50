"""One process at a time on a run."""

from __future__ import annotations

import _thread
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pipeline.errors import UserError
from pipeline.folder_lock import folder_lock
from pipeline.liveness import is_alive
from pipeline.run_folder import PROCESS, RUNNING, Run
from safe_files.regular_files import take_up


@contextmanager
def at_work_on(run: Run, say: Callable[[str], object]) -> Iterator[None]:
    """Keep others from going on with a run inside the ``with`` statement.

    Args:
        run: the run folder.
        say: told in a line what this waits for, and that the lock was lost.

    Raises:
        UserError: if another process is at work on it.
        UnsafeFileError: if anything but files and folders lies in it.
    """
    take_up(run.path)

    def stop() -> None:
        say(f"{run.path}: another process has taken this one for dead; this one stops")
        _thread.interrupt_main(signal.SIGTERM)

    with folder_lock(run.path, stop, say):
        yield


def check_left(run: Run) -> None:
    """Make sure that nobody is at work on a run that has no lock, as those of a study.

    Raises:
        UserError: if somebody is.
    """
    info = run.read_info()
    process: Any = info.get(PROCESS)
    if info.get("state") == RUNNING and is_alive(process):
        raise UserError(f"{run.path}: process {process['pid']} is at work on it")
