"""Where the runs of a study are done: a launcher takes them one by one, and tells how each ended.

`local_launcher` does them on this machine. Whatever asks for runs, a study or a search over
settings, knows no more of the place than `Launcher` says.
"""

from __future__ import annotations

import contextlib
import os
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from experiments.child_processes import (
    NO_LIMITS,
    StoppedError,
    TaskFailedError,
    local_executor,
    supervise,
)
from experiments.drafts import leave_drafts, run_name
from experiments.planned_runs import PlannedRun
from experiments.run_limits import RunLimits
from experiments.study_spec import file_name
from pipeline.errors import one_line
from pipeline.files import write_text
from pipeline.locks import is_gone
from pipeline.train_spec import is_plain


@dataclass(frozen=True)
class RunFailure:
    """A run that failed.

    Attributes:
        planned: the run.
        reason: why, in one line.
        log: the file with the details; None where it could not be written.
        details: what is in it, which is for people alone: nothing reads the file back.
    """

    planned: PlannedRun
    reason: str
    log: Path | None
    details: str = ""


class Launcher(Protocol):
    """A place where runs are done."""

    @property
    def n_workers(self) -> int:
        """How many runs it does at once, now."""

    @property
    def words(self) -> str:
        """What is to be said of it while runs are done; mostly nothing."""

    def submit(self, planned: PlannedRun) -> Future[RunFailure | None]:
        """Have a run done.

        Returns:
            How it failed; None once its folder is in place. Futures do not depend on each other.
            They raise only where the place itself is gone.
        """


# Opens a place for as long as a ``with`` statement runs; left early, it ends what is under way.
Launchers = Callable[[], AbstractContextManager[Launcher]]


def available_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def failure_log(root: Path, planned: PlannedRun) -> Path:
    """Where the details of a run's failure are written; there until it is done after all."""
    return root / "failures" / f"{file_name(planned.agent)}@{planned.path.name}.txt"


@contextlib.contextmanager
def local_launcher(
    root: Path, command: str, n_workers: int, limits: RunLimits = NO_LIMITS
) -> Iterator[Launcher]:
    """Do runs on this machine, each in a child process of its own; plain ones share them.

    Args:
        root: the study's folder.
        command: the command that asked for it, noted in every run folder.
        n_workers: how many at once.
        limits: what each may take.
    """
    with local_executor(n_workers) as executor:
        yield _LocalLauncher(executor, n_workers, root, command, limits)


@dataclass(frozen=True)
class _LocalLauncher:
    executor: Executor
    n_workers: int
    root: Path
    command: str
    limits: RunLimits
    words: str = ""

    def submit(self, planned: PlannedRun) -> Future[RunFailure | None]:
        return self.executor.submit(_supervised, planned, self.root, self.command, self.limits)


def _supervised(
    planned: PlannedRun, root: Path, command: str, limits: RunLimits
) -> RunFailure | None:
    try:
        if not is_gone(root):  # a run would make it anew
            do_supervised(planned, root, command, limits)
    except StoppedError:
        return None
    except TaskFailedError as error:
        return failed(planned, root, str(error), error.details)
    failure_log(root, planned).unlink(missing_ok=True)
    return None


def do_supervised(
    planned: PlannedRun, root: Path, command: str, limits: RunLimits, home: Path = Path()
) -> None:
    """Do a run in a child process of this one, with two tries if it dies.

    Args:
        planned: the run.
        root: the study's folder.
        command: the command that asked for it.
        limits: what it may take.
        home: the folder that relative paths begin at, those of the run and of the study too.

    Raises:
        TaskFailedError: if the run failed, or no process could be started for it.
        StoppedError: if it was ended, since this process ends.
    """
    try:
        supervise(
            _do_planned_run,
            planned,
            root,
            command,
            home,
            clean_up=partial(leave_drafts, home / root, run_name(planned)),
            limits=limits,
            shares_process=is_plain(planned.spec) and not planned.is_batch,
        )
    except (OSError, EOFError, RuntimeError) as error:  # no room, process, thread or file left
        reason = f"its process could not be started: {one_line(error)}"
        raise TaskFailedError(reason, traceback.format_exc()) from error


def _do_planned_run(planned: PlannedRun, root: Path, command: str, home: Path) -> None:
    # Imported where runs are done: it takes seconds, and a supervisor needs nothing of it.
    from experiments.run_in_child import do_planned_run

    if home.parts:
        os.chdir(home)
    do_planned_run(planned, root, command)


def failed(planned: PlannedRun, root: Path, reason: str, details: str) -> RunFailure:
    """The failure of a run, with its details written down; where the disk is full, without."""
    log = failure_log(root, planned)
    try:
        log.parent.mkdir(exist_ok=True)
        write_text(log, details)
    except OSError:
        return RunFailure(planned, reason, None, details)
    return RunFailure(planned, reason, log, details)
