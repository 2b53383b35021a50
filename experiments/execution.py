"""Doing the runs of a study: those that are missing, over all cores, in the order of the plan."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from experiments.child_processes import StoppedError, TaskFailedError, local_executor, supervise
from experiments.planned_runs import PlannedRun
from experiments.run_in_child import (
    do_run,
    draft_path,
    make_folder,
    remove_dead_drafts,
    remove_draft,
)
from experiments.study_spec import file_name
from pipeline.errors import one_line
from pipeline.files import write_text


@dataclass(frozen=True)
class RunFailure:
    """A run that failed.

    Attributes:
        planned: the run.
        reason: why, in one line.
        log: the file with the details; None where it could not be written.
    """

    planned: PlannedRun
    reason: str
    log: Path | None


Listener = Callable[[PlannedRun, RunFailure | None], None]


def failure_log(root: Path, planned: PlannedRun) -> Path:
    """Where the details of a run's failure are written; there until it is done after all."""
    return root / "failures" / f"{file_name(planned.agent)}@{planned.path.name}.txt"


def available_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def execute(
    runs: Sequence[PlannedRun], root: Path, command: str, n_workers: int, listener: Listener
) -> list[RunFailure]:
    """Do the runs, each in a process of its own.

    Args:
        runs: those to do.
        root: the study's folder.
        command: the command that asked for it, noted in every run folder.
        n_workers: how many at once.
        listener: called for every run that has ended, with how it failed if it did.

    Returns:
        Those that failed.
    """
    remove_dead_drafts(root)
    if not runs:
        return []
    with local_executor(min(n_workers, len(runs))) as executor:
        return execute_on(executor, runs, root, command, listener)


def execute_on(
    executor: Executor, runs: Sequence[PlannedRun], root: Path, command: str, listener: Listener
) -> list[RunFailure]:
    """As `execute`, wherever the workers of ``executor`` are, if they share the folder."""
    failures = []
    futures = {executor.submit(_supervised_run, run, root, command): run for run in runs}
    for future in as_completed(futures):
        failure = future.result()
        listener(futures[future], failure)
        if failure is not None:
            failures.append(failure)
    return failures


def _kept(log: Path, details: str) -> Path | None:
    """The file with the details; None where it cannot be written, as on a full disk."""
    try:
        make_folder(log.parent)
        write_text(log, details)
    except OSError:
        return None
    return log


def _supervised_run(planned: PlannedRun, root: Path, command: str) -> RunFailure | None:
    log = failure_log(root, planned)
    draft = draft_path(root, planned)
    try:
        supervise(do_run, planned, draft, command, clean_up=partial(remove_draft, draft))
    except StoppedError:
        return None
    except TaskFailedError as error:
        return RunFailure(planned, str(error), _kept(log, error.details))
    except (OSError, EOFError, RuntimeError) as error:  # no room, process, thread or file left
        reason = f"its process could not be started: {one_line(error)}"
        return RunFailure(planned, reason, _kept(log, traceback.format_exc()))
    log.unlink(missing_ok=True)
    return None
