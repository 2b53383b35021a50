"""The search itself: trials side by side, each going through its seeds until it is hopeless."""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from experiments.launching import Launcher, RunFailure
from experiments.plan import PlannedRun
from pipeline.digests import DamagedFileError
from pipeline.errors import UserError
from pipeline.files import DISK_ERRORS, plain
from pipeline.locks import FolderGoneError, is_gone
from tuning.judging import RunOutcome, UnjudgedError, judged, outcome_of
from tuning.suggesting import Suggestions
from tuning.trial_queue import (
    FAILURE,
    FIGURES,
    SECONDS,
    SETTINGS,
    TrialQueue,
    figures_of,
    seconds_of,
)
from tuning.trial_runs import planned_run
from tuning.tuning_spec import TuningSpec

if TYPE_CHECKING:
    from optuna import Trial

SECONDS_BETWEEN_LOOKS = 1.0
# So many that fail in a row, and none before that did not: then it is not their settings.
MOST_FAILURES = 5
_ROOM_FOR_A_RUN = 1 << 18  # bytes, of a small one

Hopeless = Callable[[int, Mapping[int, float]], bool]


class Listener(Protocol):
    """Who is told how far the search is."""

    def run_ended(self) -> None:
        """A run of a trial has ended."""

    def trial_ended(self, number: int, value: float | None, reason: str) -> None:
        """A trial has ended; without a value, where it was ended early or failed."""


@dataclass
class TrialUnderWay:
    """A setting that is being judged.

    Attributes:
        trial: of Optuna.
        entry: its hyperparameters.
        seeds: those that have not begun, in their order.
        figures: what came of those that are done.
        seconds: what they took.
        n_running: how many are under way.
        is_over: whether what still comes is of no interest.
    """

    trial: Trial
    entry: dict[str, Any]
    seeds: list[int]
    figures: dict[int, float] = field(default_factory=dict)
    seconds: float = 0.0
    n_running: int = 0
    is_over: bool = False


class Search:
    """A driver's part in a search.

    Args:
        tuning: what is asked for.
        root: its folder.
        queue: where trials come from.
        suggestions: what they try.
        launcher: where runs are done.
        hopeless: whether to end a trial of this number, by its figures so far.
        listener: told how far it is.
        deadline: when no further run is begun, by `time.monotonic`.
    """

    def __init__(
        self,
        tuning: TuningSpec,
        root: Path,
        queue: TrialQueue,
        suggestions: Suggestions,
        launcher: Launcher,
        hopeless: Hopeless,
        listener: Listener,
        deadline: float = math.inf,
    ) -> None:
        self.tuning, self.root, self.queue, self.suggestions = tuning, root, queue, suggestions
        self.launcher, self.hopeless, self.listener = launcher, hopeless, listener
        self.deadline = deadline
        self._trials: list[TrialUnderWay] = []
        self._runs: dict[Future[RunFailure | None], tuple[TrialUnderWay, PlannedRun]] = {}
        self._failures: list[str] | None = []  # in a row from the first on; None after a success

    def run(self) -> None:
        """Do trials until there are none left, or the time is over.

        Raises:
            UserError: if nothing but failures comes of it.
        """
        try:
            while not self._is_at_end():
                if is_gone(self.root):
                    raise FolderGoneError(self.root)
                self._hand_out()
                self._look()
        finally:
            for each in self._trials:
                self.queue.give_back(each.trial)

    @property
    def _is_late(self) -> bool:
        return time.monotonic() > self.deadline

    def _is_at_end(self) -> bool:
        return not self._runs and (self._is_late or (not self._trials and self.queue.is_done()))

    def _hand_out(self) -> None:
        """Give every worker something to do, as far as there is anything."""
        while len(self._runs) < self.launcher.n_workers and not self._is_late:
            chosen = self._idle_trial() or self._new_trial() or self._any_trial()
            if chosen is None:
                return
            self._begin(chosen, chosen.seeds.pop(0))

    def _idle_trial(self) -> TrialUnderWay | None:
        return next((each for each in self._trials if each.seeds and not each.n_running), None)

    def _any_trial(self) -> TrialUnderWay | None:
        """Where no trial is left to begin, workers would idle: seeds go side by side then."""
        open_ones = [each for each in self._trials if each.seeds]
        return min(open_ones, key=lambda each: each.n_running, default=None)

    def _new_trial(self) -> TrialUnderWay | None:
        while (trial := self.queue.claim(self.suggestions.params)) is not None:
            entry = self.suggestions.entry(trial)
            trial.set_user_attr(SETTINGS, plain(entry))
            known = figures_of(trial.user_attrs)
            seeds = [seed for seed in self.tuning.seeds if seed not in known]
            seconds = seconds_of(trial.user_attrs)
            new = TrialUnderWay(trial, entry, seeds, known, seconds)
            self._trials.append(new)
            if known:  # its driver may have ended between the last of them and the judgement
                self._judge(new)
            if not new.is_over:
                return new
        return None

    def _begin(self, each: TrialUnderWay, seed: int) -> None:
        try:
            planned = planned_run(self.tuning, self.root, each.entry, seed)
        except UserError as error:
            self._fail(each, str(error))
            return
        each.n_running += 1
        self._runs[self._submitted(planned)] = (each, planned)

    def _submitted(self, planned: PlannedRun) -> Future[RunFailure | None]:
        """A run that is there, of equal settings or a driver before, is not done again."""
        if not planned.is_finished:
            return self.launcher.submit(planned)
        done: Future[RunFailure | None] = Future()
        done.set_result(None)
        return done

    def _look(self) -> None:
        """Wait until a run has ended, or it is time to look for trials that others left."""
        if not self._runs:
            if not self.queue.free_dead() and not self._is_at_end():
                time.sleep(SECONDS_BETWEEN_LOOKS)
            return
        done, _ = wait(self._runs, SECONDS_BETWEEN_LOOKS, FIRST_COMPLETED)
        for future in done:
            each, planned = self._runs.pop(future)
            each.n_running -= 1
            if not (future.cancelled() or each.is_over):
                self._note(each, planned, future.result())
            self.listener.run_ended()

    def _note(self, each: TrialUnderWay, planned: PlannedRun, failure: RunFailure | None) -> None:
        """Take in what came of a run."""
        if failure is not None:
            _check_room(self.root)
            where = "" if failure.log is None else f"; see {failure.log}"
            self._fail(each, f"seed {planned.seed}: {failure.reason}{where}")
            return
        try:
            outcome = outcome_of(self.tuning, planned)
        except (UnjudgedError, DamagedFileError) as error:
            self._fail(each, f"seed {planned.seed}: {error}")
            return
        self._failures = None
        self._check_alike(outcome)
        each.figures[planned.seed] = outcome.figure
        each.seconds += outcome.seconds
        with _lost_to_others():
            figures = {str(seed): figure for seed, figure in each.figures.items()}
            self._report(each)
            each.trial.set_user_attr(SECONDS, each.seconds)
            each.trial.set_user_attr(FIGURES, figures)  # the last: from now on the seed is done
        self._judge(each)

    def _report(self, each: TrialUnderWay) -> None:
        step, trial_id = len(each.figures), each.trial._trial_id
        # A driver that was killed may have told it already.
        if step not in self.queue.storage.get_trial(trial_id).intermediate_values:
            each.trial.report(self._value(each), step)

    def _check_alike(self, outcome: RunOutcome) -> None:
        """Scores and returns are not to be compared: an optimum may be known since an update."""
        before = self.queue.judged_by(outcome.name)
        if before != outcome.name:
            raise UserError(
                f"{self.tuning.study.name}: runs there were judged by {before}, and now by "
                f"{outcome.name}: --name NAME makes a search of its own"
            )

    def _value(self, each: TrialUnderWay) -> float:
        figures = list(each.figures.values())
        return judged(figures, self.tuning.objective, is_cost=self.tuning.is_cost)

    def _judge(self, each: TrialUnderWay) -> None:
        """End a trial that has all its seeds, or is hopeless."""
        from optuna.trial import TrialState

        if len(each.figures) == len(self.tuning.seeds):
            value = self._value(each)
            with _lost_to_others():
                each.trial.study.tell(each.trial, value, skip_if_finished=True)
            self._end(each, value, "")
        elif each.trial.number and self.hopeless(each.trial.number, each.figures):
            with _lost_to_others():
                each.trial.study.tell(each.trial, state=TrialState.PRUNED, skip_if_finished=True)
            self._end(each, None, "")

    def _fail(self, each: TrialUnderWay, reason: str) -> None:
        """End a trial of which a run failed: to samplers it is one of the worst there are."""
        from optuna.trial import TrialState

        with _lost_to_others():
            each.trial.set_user_attr(FAILURE, reason)
            each.trial.study.tell(each.trial, state=TrialState.PRUNED, skip_if_finished=True)
        self._end(each, None, reason)
        if self._failures is not None:
            self._failures.append(reason)
            if len(self._failures) >= MOST_FAILURES:
                raise UserError(f"all of the first {MOST_FAILURES} trials failed; {reason}")

    def _end(self, each: TrialUnderWay, value: float | None, reason: str) -> None:
        each.is_over = True
        self._trials.remove(each)
        for future, (other, _) in self._runs.items():
            if other is each:
                future.cancel()  # those that have begun go on, and their folders stay
        self.listener.trial_ended(each.trial.number, value, reason)


def _check_room(root: Path) -> None:
    """Make sure that it is no full disk that runs fail of, which says nothing of their settings.

    Raises:
        UserError: if it is full.
    """
    try:
        with tempfile.TemporaryFile(dir=root) as file:
            file.write(bytes(_ROOM_FOR_A_RUN))
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise UserError(
                f"{root}: {error.strerror}: make room; what is done stays, and the same command "
                "goes on"
            ) from error


@contextlib.contextmanager
def _lost_to_others() -> Iterator[None]:
    """Let go of a trial that another driver has taken, since this one was silent for long."""
    from optuna.exceptions import UpdateFinishedTrialError

    with contextlib.suppress(UpdateFinishedTrialError, ValueError):
        yield
