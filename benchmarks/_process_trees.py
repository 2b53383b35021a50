"""What a command takes with all the processes that it starts, a study's runs among them."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence

PR_SET_CHILD_SUBREAPER = 36


def timed(command: Sequence[str]) -> tuple[float, float]:
    """Run a command, and wait until all that it has started is gone.

    Returns:
        Seconds until the command ended, and of processors in all; nan where the system does not let
        this process wait for grandchildren, as only Linux does.

    Raises:
        CalledProcessError: if the command fails.
    """
    can_adopt = sys.platform == "linux"
    if can_adopt:
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    before, started = _processors(), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    wall = time.perf_counter() - started
    if not can_adopt:
        return wall, float("nan")
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    return wall, _processors() - before


def _processors() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
