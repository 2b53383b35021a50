"""Launches the runs of a study in order, and estimates the remaining time.

A launcher accepts runs one by one, and returns how each ended. `local_launcher` does them on this
machine. A study or a search over settings uses only the interface `Launcher`.
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

from rl_yardstick.experiments.child_processes import (
    NO_LIMITS,
    StoppedError,
    TaskFailedError,
    local_executor,
    supervise,
)
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.run_folders import (
    draft_path,
    leave_drafts,
    remove_dead_drafts,
    run_name,
)
from rl_yardstick.experiments.run_limits import RunLimits
from rl_yardstick.experiments.study import StudySpec, file_name
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.digests import DamagedFileError
from rl_yardstick.pipeline.errors import one_line
from rl_yardstick.pipeline.files import write_text
from rl_yardstick.pipeline.locks import FolderGoneError, is_gone
from rl_yardstick.pipeline.train_spec import FAMILIES, NETWORKS, TrainSpec, is_plain

if TYPE_CHECKING:
    from rl_yardstick.experiments.results import RunResults


@dataclass(frozen=True)
class RunFailure:
    """A failed run."""

    planned: PlannedRun  #: the run
    reason: str  #: why, in one line
    log: Path | None  #: the file with the details; None if it could not be written
    details: str = ""  #: its content, for readers: no program reads the file back


class Launcher(Protocol):
    """The interface to this machine or a cluster, which does runs."""

    @property
    def n_workers(self) -> int:
        """The current number of parallel runs."""

    @property
    def words(self) -> str:
        """A text on the launcher to show during runs, such as its workers; may be empty."""

    def submit(self, planned: PlannedRun) -> Future[RunFailure | None]:
        """Submit a run.

        Returns:
            A future with the failure, or with None once the run's folder is in place. It raises an
            error only if the launcher itself is lost.
        """


# Opens a launcher during a ``with`` statement; on early exit, it ends running runs.
Launchers = Callable[[], AbstractContextManager[Launcher]]


def available_cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def failure_log(root: Path, planned: PlannedRun) -> Path:
    """The file with the details of a run's failure; it exists until the run succeeds."""
    return root / "failures" / f"{file_name(planned.agent)}@{planned.path.name}.txt"


@contextlib.contextmanager
def local_launcher(
    root: Path, command: str, n_workers: int, limits: RunLimits = NO_LIMITS
) -> Iterator[Launcher]:
    """Do runs on this machine, each in its own child process; plain runs share processes.

    Args:
        root: the study's folder.
        command: the user's command, recorded in every run folder.
        n_workers: the number of parallel runs.
        limits: the limits of each run.
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
            if not is_gone(self.root):  # a run would recreate it
                do_supervised(planned, self.root, self.command, self.limits)
        except StoppedError:
            return None
        except TaskFailedError as error:
            return ended(planned, self.root, str(error), error.details)
        return ended(planned, self.root)


def do_supervised(
    planned: PlannedRun, root: Path, command: str, limits: RunLimits, home: Path = Path()
) -> None:
    """Do a run in a child process, with one retry if the process dies.

    Relative paths, including those of run and study, start at ``home``.

    Raises:
        TaskFailedError: if the run failed, or no process could be started.
        StoppedError: if the run was stopped because this process ends.
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
    except (OSError, EOFError, RuntimeError) as error:  # no memory, process, thread or file left
        reason = f"its process could not be started: {one_line(error)}"
        raise TaskFailedError(reason, traceback.format_exc()) from error


def _do_planned_run(planned: PlannedRun, root: Path, command: str, home: Path) -> None:
    # A slow import that a supervisor does not need.
    from rl_yardstick.experiments.run_in_child import do_run

    if home.parts:  # on a worker, which has compared the modules with the driver's
        from rl_yardstick.pipeline.user_modules import import_checked

        os.chdir(home)
        import_checked(planned.spec.user_modules)
    do_run(planned, draft_path(root, planned), command)


def ended(
    planned: PlannedRun, root: Path, reason: str = "", details: str = ""
) -> RunFailure | None:
    """Write the details of a failure, and return it; None without a reason.

    If the disk is full, no details are written.
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


# --- Doing missing runs, in the order of the plan.

# Submitted runs per parallel run: enough that no worker waits for the next run, and few enough that
# a hundred thousand runs do not overload a launcher.
WINDOW = 2
# The time-out after which new workers get runs, even if no run has ended.
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
        runs: the runs to do.
        root: the study's folder.
        launchers: opens the launcher; called only if there are runs to do.
        listener: called for every ended run, with its failure, if any.
        meanwhile: called once, during the first runs.

    Returns:
        The failed runs.

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


# --- The remaining time of the runs, by the clock.

# The time of a run differs a thousandfold between agents, so each agent on each environment has its
# own estimate: the mean of its ended runs; without them, its expected time, multiplied by the mean
# ratio of actual to expected time of similar agents.

Key = tuple[str, str]

# Fixed seconds of a run, and seconds per step: of compiled agents with tables or weights, and of
# all other agents.
EACH_RUN = 0.3
EACH_STEP, EACH_SLOW_STEP = 3e-7, 1e-3
# If a budget counts episodes, this is the assumed length.
STEPS_OF_EPISODE = 100
# An overdue run is expected to take this multiple of its elapsed time.
LONGER = 1.2
# The largest factor by which times of tables may raise the estimates of networks.
BUSY = 4.0


def expected_seconds(spec: TrainSpec, processor_seconds: float | None = None) -> float | None:
    """The expected seconds of a run; for networks, the processor time may be known.

    None for the user's agents, which may be compiled or not.
    """
    if processor_seconds:
        return EACH_RUN + processor_seconds
    from rl_yardstick.agents import ALGORITHMS

    entry = ALGORITHMS.get(spec.algo)
    if entry is None or not (entry.package or entry.entry_point.startswith("rl_yardstick.agents.")):
        return None
    budget = spec.hyperparams
    steps = budget.n_timesteps or STEPS_OF_EPISODE * (budget.n_episodes or 1)
    is_fast = entry.family in {*FAMILIES, "bandits"}
    return EACH_RUN + steps * (EACH_STEP if is_fast else EACH_SLOW_STEP)


class TimeLeft:
    """Estimates the time until all runs have ended.

    Runs start in order, each when another one ends, so starts need not be reported.

    Args:
        runs: the runs, in order.
        expected: seconds of a run by agent and environment, as far as known.
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
        """Start as many runs as there are free workers."""
        while self._waiting and len(self._began) < n_workers:
            run = self._waiting.popleft()
            self._n_waiting[run.labels] -= 1
            self._began[run.path] = (run, now)

    def end(self, run: PlannedRun, now: float) -> None:
        """Record the end of a run."""
        if run.path not in self._began:  # a run that was assumed to have begun has not: swap them
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
        """The remaining seconds of all runs; None while there is no estimate."""
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
        """The estimated seconds of a run, by agent and environment."""
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
                if not like:  # on a busy machine, all runs take longer
                    like = [min(max(ratio, 1.0), BUSY) for _, ratio in off]
                found[key] = expected * (sum(like) / len(like) if like else 1.0)
        for key, began in self._under_way():
            if key not in self._taken and key in found:
                found[key] = max(found[key], LONGER * (now - began))
        return found

    def _by_how_much_off(self, now: float) -> list[tuple[str, float]]:
        """Agents, and the ratio of actual to expected time of their runs."""
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


# --- Reading results while other runs are still running.


class EarlyResults:
    """Reads the results of each run of a study as soon as it has ended."""

    def __init__(self, study: StudySpec) -> None:
        self.study = study
        self._found: dict[Path, RunResults] = {}

    def get_ready(self) -> None:
        """Load the slow imports of reading; best called during the first runs."""
        with loading_libraries():
            import experiments.results  # noqa: F401

    def read(self, planned: PlannedRun) -> RunResults | None:
        """Read a run that has just ended; damage is reported later."""
        from rl_yardstick.experiments.results import read_run

        with contextlib.suppress(DamagedFileError):
            found = read_run(self.study, planned)
            if found is not None:
                self._found[planned.path] = found
            return found
        return None

    def forget(self, planned: PlannedRun) -> None:
        """Drop the results of a run, because it is stored."""
        self._found.pop(planned.path, None)

    def of(self, planned: PlannedRun) -> RunResults | None:
        """Like `read_run`, but returns a result that was read before."""
        from rl_yardstick.experiments.results import read_run

        return self._found.get(planned.path) or read_run(self.study, planned)
