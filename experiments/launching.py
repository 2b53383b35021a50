"""Where the runs of a study are done, in which order, and how long they may still take.

A launcher takes runs one by one, and tells how each ended. `local_launcher` does them on this
machine. Whatever asks for runs, a study or a search over settings, knows no more of the place than
`Launcher` says.
"""

from __future__ import annotations

import contextlib
import os
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from experiments.child_processes import (
    NO_LIMITS,
    StoppedError,
    TaskFailedError,
    local_executor,
    supervise,
)
from experiments.plan import PlannedRun
from experiments.run_folders import draft_path, leave_drafts, remove_dead_drafts, run_name
from experiments.run_limits import RunLimits
from experiments.study import StudySpec, file_name
from pipeline import loading_libraries
from pipeline.digests import DamagedFileError
from pipeline.errors import one_line
from pipeline.files import write_text
from pipeline.locks import FolderGoneError, is_gone
from pipeline.train_spec import FAMILIES, NETWORKS, TrainSpec, is_plain
from safe_files.files import hold

if TYPE_CHECKING:
    from experiments.results import RunResults


@dataclass(frozen=True)
class RunFailure:
    """A run that failed."""

    planned: PlannedRun  #: the run
    reason: str  #: why, in one line
    log: Path | None  #: the file with the details; None where it could not be written
    details: str = ""  #: what is in it, which is for people alone: nothing reads the file back


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
        return self.executor.submit(self._do, planned)

    def _do(self, planned: PlannedRun) -> RunFailure | None:
        try:
            if not is_gone(self.root):  # a run would make it anew
                do_supervised(planned, self.root, self.command, self.limits)
        except StoppedError:
            return None
        except TaskFailedError as error:
            return ended(planned, self.root, str(error), error.details)
        return ended(planned, self.root)


def do_supervised(
    planned: PlannedRun, root: Path, command: str, limits: RunLimits, home: Path = Path()
) -> None:
    """Do a run in a child process of this one, with two tries if it dies.

    Relative paths, those of the run and of the study too, begin at ``home``.

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
    from experiments.run_in_child import do_run

    if home.parts:
        os.chdir(home)
    hold(root)
    do_run(planned, draft_path(root, planned), command)


def ended(
    planned: PlannedRun, root: Path, reason: str = "", details: str = ""
) -> RunFailure | None:
    """How a run failed, with its details written down; None where there is no reason.

    Where the disk is full, there are no details.
    """
    log = failure_log(root, planned)
    if not reason:
        log.unlink(missing_ok=True)
        return None
    try:
        log.parent.mkdir(exist_ok=True)
        write_text(log, details)
    except OSError:
        return RunFailure(planned, reason, None, details)
    return RunFailure(planned, reason, log, details)


# --- Doing the runs that are missing, in the order of the plan.

# Runs that are handed over at a time, for each that is done at once: enough that no worker waits
# for the next, and few enough that a hundred thousand are no burden to whoever does them.
WINDOW = 2
# So that workers that have joined meanwhile do not wait until a run has ended.
SECONDS_BETWEEN_LOOKS = 1.0

Listener = Callable[[PlannedRun, RunFailure | None], None]


def execute(
    runs: Sequence[PlannedRun],
    root: Path,
    launchers: Launchers,
    listener: Listener,
    meanwhile: Callable[[], object] = bool,
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
    failures, to_do = [], iter(runs)
    under_way: dict[Future[RunFailure | None], PlannedRun] = {}
    with launchers() as launcher:
        while True:
            if is_gone(root):
                raise FolderGoneError(root)
            room = WINDOW * max(launcher.n_workers, 1) - len(under_way)
            under_way |= {launcher.submit(run): run for run in islice(to_do, max(room, 0))}
            if not under_way:
                break
            meanwhile()
            meanwhile = bool
            done = wait(under_way, SECONDS_BETWEEN_LOOKS, FIRST_COMPLETED).done
            for future in [each for each in under_way if each in done]:
                planned, failure = under_way.pop(future), future.result()
                listener(planned, failure)
                failures += [] if failure is None else [failure]
    remove_dead_drafts(root, {run_name(failure.planned) for failure in failures})
    return failures


# --- How long the runs that are left may take, by the clock.

# Agents differ a thousandfold in what a run takes, so each agent on each environment has an
# estimate of its own: the mean of its runs that have ended, or else what it is expected to take,
# times how far the expectations of like agents were off.

Key = tuple[str, str]

# Seconds of a run in any case, and for each step: of compiled agents with tables or weights, and of
# all others, of which nothing else is known.
EACH_RUN = 0.3
EACH_STEP, EACH_SLOW_STEP = 3e-7, 1e-3
# Where a budget counts episodes, their length is guessed.
STEPS_OF_EPISODE = 100
# A run that takes longer than was expected is expected to take so much of what it has taken.
LONGER = 1.2
# By how much what tables took may lengthen what is expected of networks.
BUSY = 4.0


def expected_seconds(spec: TrainSpec, processor_seconds: float | None = None) -> float | None:
    """What a run is expected to take; of networks the processor time may be known.

    None for an agent of the user's, which may be compiled or not.
    """
    if processor_seconds:
        return EACH_RUN + processor_seconds
    from agents import ALGORITHMS

    entry = ALGORITHMS.get(spec.algo)
    if entry is None or not (entry.package or entry.entry_point.startswith("agents.")):
        return None
    budget = spec.hyperparams
    steps = budget.n_timesteps or STEPS_OF_EPISODE * (budget.n_episodes or 1)
    is_fast = entry.family in {*FAMILIES, "bandits"}
    return EACH_RUN + steps * (EACH_STEP if is_fast else EACH_SLOW_STEP)


class TimeLeft:
    """Estimates when the last of some runs will have ended.

    Runs start in their order, one where another has ended: when each has begun need not be told.

    Args:
        runs: to be done, in this order.
        expected: seconds of a run by agent and environment, where something is known of them.
    """

    def __init__(self, runs: Sequence[PlannedRun], expected: Mapping[Key, float]) -> None:
        self._waiting = deque(runs)
        self._n_waiting = Counter(run.labels for run in runs)
        self._began: dict[Path, tuple[PlannedRun, float]] = {}
        first = {run.labels: run for run in runs}
        self._algos = {key: run.spec.algo for key, run in first.items()}
        self._expected = {
            key: expected.get(key) or expected_seconds(run.spec) for key, run in first.items()
        }
        self._taken: dict[Key, list[float]] = {}

    def start(self, now: float, n_workers: int) -> None:
        """Let runs begin, as many as there are free workers."""
        while self._waiting and len(self._began) < n_workers:
            run = self._waiting.popleft()
            self._n_waiting[run.labels] -= 1
            self._began[run.path] = (run, now)

    def end(self, run: PlannedRun, now: float) -> None:
        """Count a run that has ended."""
        if run.path not in self._began:  # another has not begun instead
            if not (self._began and run in self._waiting):
                return
            path, (other, began) = next(iter(self._began.items()))
            self._waiting[self._waiting.index(run)] = other
            self._n_waiting[run.labels] -= 1
            self._n_waiting[other.labels] += 1
            del self._began[path]
            self._began[run.path] = (run, began)
        self._taken.setdefault(run.labels, []).append(now - self._began.pop(run.path)[1])

    def seconds(self, now: float, n_workers: int) -> float | None:
        """How long all runs together may still take; None while that cannot be said."""
        each = self._estimates(now)
        missing = [*(key for key, _ in self._under_way()), *+self._n_waiting]
        if not each.keys() >= set(missing):
            return None
        under_way = [
            max(each[key] - (now - began), (LONGER - 1) * (now - began))
            for key, began in self._under_way()
        ]
        left = sum(under_way) + sum(each[key] * n for key, n in self._n_waiting.items())
        return max([left / max(n_workers, 1), *under_way])

    def _under_way(self) -> list[tuple[Key, float]]:
        return [(run.labels, began) for run, began in self._began.values()]

    def _estimates(self, now: float) -> dict[Key, float]:
        """Seconds of a run, by agent and environment."""
        off = self._by_how_much_off(now)
        found = {}
        for key, expected in self._expected.items():
            if key in self._taken:
                found[key] = sum(self._taken[key]) / len(self._taken[key])
            elif expected is not None:
                algo = self._algos[key]
                like = [ratio for other, ratio in off if other == algo] or [
                    ratio for other, ratio in off if (other in NETWORKS) == (algo in NETWORKS)
                ]
                if not like:  # on a busy machine everything takes longer
                    like = [min(max(ratio, 1.0), BUSY) for _, ratio in off]
                found[key] = expected * (sum(like) / len(like) if like else 1.0)
        for key, began in self._under_way():
            if key not in self._taken and key in found:
                found[key] = max(found[key], LONGER * (now - began))
        return found

    def _by_how_much_off(self, now: float) -> list[tuple[str, float]]:
        """Agents, and what their runs took by what they were expected to take."""
        off = [
            (self._algos[key], sum(taken) / len(taken) / expected)
            for key, taken in self._taken.items()
            if (expected := self._expected[key]) is not None
        ]
        known = {algo for algo, _ in off}
        late = [
            (self._algos[key], LONGER * (now - began) / expected)
            for key, began in self._under_way()
            if (expected := self._expected[key]) is not None
        ]
        return off + [(algo, ratio) for algo, ratio in late if ratio > 1 and algo not in known]


# --- What runs have to say, read while others are still under way.


class EarlyResults:
    """What each run of a study has to say, read when it has ended."""

    def __init__(self, study: StudySpec) -> None:
        self.study = study
        self._found: dict[Path, RunResults] = {}

    def get_ready(self) -> None:
        """Load what reading takes, which is long: best while the first runs are under way."""
        with loading_libraries():
            import experiments.results  # noqa: F401

    def read(self, planned: PlannedRun) -> None:
        """Read a run that has just ended; one that is damaged is found to be so at the end."""
        from experiments.results import read_run

        with contextlib.suppress(DamagedFileError):
            found = read_run(self.study, planned)
            if found is not None:
                self._found[planned.path] = found

    def of(self, planned: PlannedRun) -> RunResults | None:
        """As `read_run`, where that was not done before."""
        from experiments.results import read_run

        return self._found.get(planned.path) or read_run(self.study, planned)
