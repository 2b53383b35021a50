"""Doing the runs of a study: those that are missing, over all cores, in the order of the plan."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from experiments.child_processes import (
    NO_LIMITS,
    StoppedError,
    TaskFailedError,
    local_executor,
    supervise,
)
from experiments.drafts import leave_drafts, make_folder, remove_dead_drafts, run_name
from experiments.planned_runs import PlannedRun
from experiments.run_in_child import do_planned_run
from experiments.run_limits import RunLimits
from experiments.study_spec import file_name
from pipeline.errors import one_line
from pipeline.files import write_text
from pipeline.plain_runs import is_plain


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
    runs: Sequence[PlannedRun],
    root: Path,
    command: str,
    n_workers: int,
    listener: Listener,
    limits: RunLimits = NO_LIMITS,
) -> list[RunFailure]:
    """Do the runs, each in a process of its own, but for plain ones, of which many share one.

    Args:
        runs: those to do.
        root: the study's folder.
        command: the command that asked for it, noted in every run folder.
        n_workers: how many at once.
        listener: called for every run that has ended, with how it failed if it did.
        limits: what each may take.

    Returns:
        Those that failed.
    """
    remove_dead_drafts(root, {run_name(run) for run in runs})
    if not runs:
        return []
    with local_executor(min(n_workers, len(runs))) as executor:
        failures = execute_on(executor, runs, root, command, listener, limits)
    remove_dead_drafts(root, {run_name(failure.planned) for failure in failures})
    return failures


def execute_on(
    executor: Executor,
    runs: Sequence[PlannedRun],
    root: Path,
    command: str,
    listener: Listener,
    limits: RunLimits = NO_LIMITS,
) -> list[RunFailure]:
    """As `execute`, wherever the workers of ``executor`` are, if they share the folder."""
    failures = []
    futures = {executor.submit(_supervised_run, run, root, command, limits): run for run in runs}
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


def _supervised_run(
    planned: PlannedRun, root: Path, command: str, limits: RunLimits
) -> RunFailure | None:
    log, name = failure_log(root, planned), run_name(planned)
    clean_up = partial(leave_drafts, root, name)
    try:
        supervise(
            do_planned_run,
            planned,
            root,
            command,
            clean_up=clean_up,
            limits=limits,
            shares_process=is_plain(planned.spec) and not planned.is_batch,
        )
    except StoppedError:
        return None
    except TaskFailedError as error:
        return RunFailure(planned, str(error), _kept(log, error.details))
    except (OSError, EOFError, RuntimeError) as error:  # no room, process, thread or file left
        reason = f"its process could not be started: {one_line(error)}"
        return RunFailure(planned, reason, _kept(log, traceback.format_exc()))
    log.unlink(missing_ok=True)
    return None
