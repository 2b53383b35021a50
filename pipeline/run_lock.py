"""One process at a time on a run."""

from __future__ import annotations

import _thread
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from pipeline.errors import UserError
from pipeline.folder_lock import folder_lock
from pipeline.liveness import is_alive
from pipeline.run_folder import PROCESS, RUNNING, Run
from safe_files.files import take_up


@contextmanager
def at_work_on(run: Run, say: Callable[[str], object]) -> Iterator[None]:
    """Keep others from going on with a run inside the ``with`` statement.

    Args:
        run: the run folder.
        say: told in a line what this waits for.

    Raises:
        UserError: if another process is at work on it, or it is gone.
        UnsafeFileError: if anything but files and folders lies in it.
    """
    take_up(run.path)
    with folder_lock(run.path, partial(_thread.interrupt_main, signal.SIGTERM), say):
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
