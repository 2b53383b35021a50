"""Doing the runs of a study: those that are missing, in the order of the plan."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue

from experiments.drafts import remove_dead_drafts, run_name
from experiments.launching import Launcher, Launchers, RunFailure
from experiments.planned_runs import PlannedRun
from pipeline.locks import FolderGoneError, is_gone

# Runs that are handed over at a time, for each that is done at once: enough that no worker waits
# for the next, and few enough that a hundred thousand are no burden to whoever does them.
WINDOW = 2
# So that workers that have joined meanwhile do not wait until a run has ended.
SECONDS_BETWEEN_LOOKS = 1.0

Listener = Callable[[PlannedRun, RunFailure | None], None]
Ended = tuple[PlannedRun, Future[RunFailure | None]]


def _nothing() -> None:
    """Wait for the runs."""


def execute(
    runs: Sequence[PlannedRun],
    root: Path,
    launchers: Launchers,
    listener: Listener,
    meanwhile: Callable[[], object] = _nothing,
) -> list[RunFailure]:
    """Do the runs.

    Args:
        runs: those to do.
        root: the study's folder.
        launchers: where; it is opened only if there is something to do.
        listener: called for every run that has ended, with how it failed if it did.
        meanwhile: called once, while the first runs are under way.

    Returns:
        Those that failed.

    Raises:
        FolderGoneError: if somebody removes the folder.
    """
    remove_dead_drafts(root, {run_name(run) for run in runs})
    if not runs:
        return []
    failures = []
    with launchers() as launcher:
        for planned, failure in _ended(launcher, runs, root, meanwhile):
            listener(planned, failure)
            if failure is not None:
                failures.append(failure)
    remove_dead_drafts(root, {run_name(failure.planned) for failure in failures})
    return failures


def _ended(
    launcher: Launcher, runs: Sequence[PlannedRun], root: Path, meanwhile: Callable[[], object]
) -> Iterator[tuple[PlannedRun, RunFailure | None]]:
    """Each run when it has ended, with how it failed; a window of them is under way."""
    ended: SimpleQueue[Ended] = SimpleQueue()
    to_do, n_under_way, is_first = iter(runs), 0, True
    while True:
        if is_gone(root):
            raise FolderGoneError(root)
        room = WINDOW * max(launcher.n_workers, 1) - n_under_way
        for planned in islice(to_do, max(room, 0)):
            future = launcher.submit(planned)
            n_under_way += 1
            future.add_done_callback(partial(_note, ended, planned))
        if not n_under_way:
            return
        if is_first:
            meanwhile()
            is_first = False
        with contextlib.suppress(Empty):
            planned, future = ended.get(timeout=SECONDS_BETWEEN_LOOKS)
            n_under_way -= 1
            yield planned, future.result()


def _note(
    ended: SimpleQueue[Ended], planned: PlannedRun, future: Future[RunFailure | None]
) -> None:
    ended.put((planned, future))
