"""The search: parallel trials, each of which runs its seeds until it is hopeless."""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from optuna import Study, Trial
from optuna.distributions import distribution_to_json
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import TrialState

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.experiments.launching import Launcher, RunFailure
from rl_yardstick.experiments.plan import PlannedRun, check_settings
from rl_yardstick.experiments.results import Curve, read_run
from rl_yardstick.pipeline.digests import DamagedFileError
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import DISK_ERRORS, plain
from rl_yardstick.pipeline.locks import FolderGoneError, is_gone
from rl_yardstick.tuning.pruning import is_hopeless
from rl_yardstick.tuning.search_spaces import read_search_space, steps_aside
from rl_yardstick.tuning.suggesting import (
    Suggestions,
    check_entry,
    make_sampler,
    name_of,
    planned_run,
    shipped_run,
)
from rl_yardstick.tuning.trial_storage import (
    AT_OPTIMUM,
    FAILURE,
    FIGURES,
    JUDGED_BY,
    SECONDS,
    SETTINGS,
    TrialQueue,
    figures_of,
    open_storage,
    open_study,
    seconds_of,
    turn,
)
from rl_yardstick.tuning.tuning_spec import AUTO, COST_OF_THRESHOLD, TuningSpec, judged
from rl_yardstick.verdicts import steps_to_threshold

SECONDS_BETWEEN_LOOKS = 1.0
# If this many trials fail at the start without a success, the settings are not the reason.
MOST_FAILURES = 5
_ROOM_FOR_A_RUN = 1 << 18  # bytes of a small run
# Penalty for never reaching the threshold: twice the budget (PAR-2). If only the steps done
# counted, giving up early would look cheap.
WHOLE_RUNS = 2
# Scores from here on are the optimum, up to rounding.
OPTIMAL_SCORE = 1 - 1e-6
# A search ends with this many settings at the optimum on all seeds, or with as many as are
# re-tested, if that is more.
ENOUGH_AT_OPTIMUM = 10


@dataclass(frozen=True)
class OpenTuning:
    """A checked tuning with open storage."""

    tuning: TuningSpec  # its specification
    root: Path  # its folder
    study: Study  # Optuna's study
    queue: TrialQueue  # its trials
    suggestions: Suggestions  # the settings of its trials

    def hopeless(self, number: int, figures: Mapping[int, float]) -> bool:
        """Whether a trial can no longer be the best, by its seeds so far."""
        sign = -1.0 if self.tuning.is_cost else 1.0
        others = [
            {seed: sign * figure for seed, figure in figures_of(trial.user_attrs).items()}
            for trial in self.queue.trials()
            if trial.number != number
        ]
        scores = {seed: sign * figure for seed, figure in figures.items()}
        # Costs change their sign, so that higher is better.
        value = partial(judged, objective=self.tuning.objective, is_cost=False)
        # A score of 1 is the optimum. Without a known optimum, figures are returns, for which 1
        # means nothing.
        is_score = self.queue.known_figure == "score"
        return is_hopeless(
            scores,
            others,
            self.tuning.pruner,
            value,
            n_seeds=len(self.tuning.seeds),
            ceiling=1.0 if is_score else -math.inf,
        )

    @property
    def n_at_optimum(self) -> int:
        """Number of settings that have the optimal score on all seeds of the search."""
        n_seeds, said = len(self.tuning.seeds), [t.user_attrs for t in self.queue.trials()]
        optimal = [each for each in said if len(figures_of(each, AT_OPTIMUM)) == n_seeds]
        return len({name_of(each[SETTINGS]) for each in optimal})

    @property
    def is_saturated(self) -> bool:
        """Whether enough settings have the optimum on all seeds, so that the search can end."""
        return self.n_at_optimum >= max(ENOUGH_AT_OPTIMUM, self.tuning.retest)


def open_tuning(tuning: TuningSpec, root: Path, storage: str | None) -> OpenTuning:
    """Check a tuning, and open the storage of its trials.

    Makes the folder if all checks pass; ``storage`` is the value of ``--storage``.
    """
    run = shipped_run(tuning, root)
    check_settings(tuning.study, [run])
    if tuning.figure == AUTO:
        is_bandit = ALGORITHMS[tuning.agent.algo].for_bandits
        tuning = replace(tuning, figure="regret" if is_bandit else "score")
    agent = tuning.agent
    space = read_search_space(agent.algo, tuning.environment.env_id, tuning.search_space)
    suggestions = Suggestions(tuning, space, run.spec.saved_hyperparams)
    if not suggestions.n_free:
        raise UserError(f"{agent.algo}: its search space leaves nothing to choose")
    for settings in steps_aside(suggestions.space, suggestions.first):
        check_entry(tuning, root, suggestions.merged(settings))
    n_trials = suggestions.n_trials
    ranges = suggestions.space.distributions()
    as_json = {name: distribution_to_json(kind) for name, kind in ranges.items()}
    asked = tuning.identity(suggestions.shipped, as_json)
    with _made(root):
        with turn(root):  # parallel drivers that create the tables of one file would fail
            opened = open_storage(root, storage)
        study = open_study(tuning, root, opened, make_sampler(tuning), asked)
    return OpenTuning(tuning, root, study, TrialQueue(study, root, n_trials), suggestions)


@contextlib.contextmanager
def _made(root: Path) -> Iterator[None]:
    """Make a folder; on an error, remove it again if it is empty."""
    root.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in (root, *list(root.parents)[:2]):
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


# The figure of a run.


class UnjudgedError(Exception):
    """A run exists, but has no figure for a search."""


@dataclass(frozen=True)
class RunOutcome:
    """The result of a run."""

    figure: float  # the figure for the search
    seconds: float  # its processor time
    name: str  # name of the figure: as requested, or the final return if no score is known
    steps: float | None = None  # steps to the threshold, if the score is optimal


def outcome_of(tuning: TuningSpec, planned: PlannedRun) -> RunOutcome:
    """Read the figure of a finished run, and its time.

    UnjudgedError if it has no such figure, DamagedFileError if one of its files is missing or
    changed, UserError if no run can have the figure because the threshold is not defined.
    """
    results = read_run(tuning.study, planned)
    if results is None:
        raise UnjudgedError("it has not finished")
    row, name = results.rows[0], tuning.figure
    if name == "score" and row.get(name) is None:  # no known optimum
        name = "final"
    is_cost = name in COST_OF_THRESHOLD
    figure = _cost(tuning, name, row, results.curves[0]) if is_cost else row.get(name)
    if figure is None or not math.isfinite(figure):
        raise UnjudgedError(f"it has no figure for {name}")
    steps = None
    if name == "score" and figure >= OPTIMAL_SCORE and row.get("threshold") is not None:
        steps = _cost(tuning, "steps", row, results.curves[0])
    return RunOutcome(float(figure), float(row.get("cpu_seconds") or row["seconds"]), name, steps)


def _cost(tuning: TuningSpec, name: str, row: Mapping[str, Any], evaluations: Curve) -> float:
    """Steps or seconds until the learning curve reaches the threshold.

    Source: for PAR-k, Hutter et al. (2009), "ParamILS", JAIR 36.
    """
    threshold = row.get("threshold")
    if threshold is None:
        raise UserError(
            f"--metric {name}: no threshold is known on "
            f"{tuning.environment.env_id}; give --threshold"
        )
    figures = evaluations.figures
    points = figures["step" if name == "steps" else "seconds"]
    reached = steps_to_threshold(points, figures["value"], float(threshold))
    whole = float(row["n_timesteps"] if name == "steps" else row["seconds"])
    return float(reached) if math.isfinite(reached) else WHOLE_RUNS * whole


# The loop.


class Listener(Protocol):
    """Receives the progress of a search."""

    def run_ended(self) -> None:
        """A run of a trial has ended."""

    def trial_ended(self, number: int, value: float | None, reason: str) -> None:
        """A trial has ended; without a value if it was pruned or failed."""


@dataclass
class TrialUnderWay:
    """A running trial."""

    trial: Trial  # Optuna's trial
    entry: dict[str, Any]  # its hyperparameters
    seeds: list[int]  # seeds that have not begun, in order
    figures: dict[int, float]  # figures of finished seeds
    seconds: float  # time of finished seeds
    steps: dict[int, float]  # by finished seed with the optimum, the steps to the threshold
    n_running: int = 0  # number of running seeds
    is_over: bool = False  # whether further results are ignored


class Search:
    """A driver's part in a search; starts no run after the deadline (`time.monotonic`)."""

    def __init__(
        self,
        place: OpenTuning,
        launcher: Launcher,
        listener: Listener,
        deadline: float = math.inf,
    ) -> None:
        self.place, self.tuning, self.queue = place, place.tuning, place.queue
        self.launcher, self.listener, self.deadline = launcher, listener, deadline
        self._trials: list[TrialUnderWay] = []
        self._runs: dict[Future[RunFailure | None], tuple[TrialUnderWay, PlannedRun]] = {}
        self._failures: list[str] | None = []  # since the start; None after a success

    def run(self) -> None:
        """Do trials until all have ended, or the deadline has passed."""
        try:
            while not self._is_at_end():
                if is_gone(self.place.root):
                    raise FolderGoneError(self.place.root)
                self._hand_out()
                self._look()
        finally:
            for each in self._trials:
                self.queue.give_back(each.trial)

    @property
    def _is_late(self) -> bool:
        return time.monotonic() > self.deadline

    def _is_at_end(self) -> bool:
        if self._runs or self._is_late:
            return not self._runs
        return not self._trials and (self.queue.is_done() or self._is_saturated_by_all())

    def _is_saturated_by_all(self) -> bool:
        """Whether the search is saturated, and no driver has a trial under way."""
        is_running = any(trial.state == TrialState.RUNNING for trial in self.queue.trials())
        return not is_running and self.place.is_saturated

    def _hand_out(self) -> None:
        """Submit runs to all free workers, as long as there are any."""
        while len(self._runs) < self.launcher.n_workers and not self._is_late:
            chosen = self._idle_trial() or self._new_trial() or self._any_trial()
            if chosen is None:
                return
            self._begin(chosen, chosen.seeds.pop(0))

    def _idle_trial(self) -> TrialUnderWay | None:
        return next((each for each in self._trials if each.seeds and not each.n_running), None)

    def _any_trial(self) -> TrialUnderWay | None:
        """A trial for parallel seeds, so that workers do not idle if no trial is left to begin."""
        open_ones = [each for each in self._trials if each.seeds]
        return min(open_ones, key=lambda each: each.n_running, default=None)

    def _new_trial(self) -> TrialUnderWay | None:
        while not self.place.is_saturated:
            trial = self.queue.claim(self.place.suggestions.params)
            if trial is None:
                return None
            entry = self.place.suggestions.entry(trial)
            trial.set_user_attr(SETTINGS, plain(entry))
            known, seconds = figures_of(trial.user_attrs), seconds_of(trial.user_attrs)
            seeds = [seed for seed in self.tuning.seeds if seed not in known]
            steps = figures_of(trial.user_attrs, AT_OPTIMUM)
            new = TrialUnderWay(trial, entry, seeds, known, seconds, steps)
            self._trials.append(new)
            if known:  # its driver may have died after the last seed
                self._judge(new)
            if not new.is_over:
                return new
        return None

    def _begin(self, each: TrialUnderWay, seed: int) -> None:
        try:
            planned = planned_run(self.tuning, self.place.root, each.entry, seed)
        except UserError as error:
            self._fail(each, str(error))
            return
        each.n_running += 1
        if planned.is_finished:  # by an equal trial, or an earlier driver
            future: Future[RunFailure | None] = Future()
            future.set_result(None)
        else:
            future = self.launcher.submit(planned)
        self._runs[future] = (each, planned)

    def _look(self) -> None:
        """Wait for the end of a run, or for the time to check for abandoned trials."""
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
        """Process the result of a run."""
        if failure is not None:
            _check_room(self.place.root)
            where = "" if failure.log is None else f"; see {failure.log}"
            self._fail(each, f"seed {planned.seed}: {failure.reason}{where}")
            return
        try:
            outcome = outcome_of(self.tuning, planned)
        except (UnjudgedError, DamagedFileError) as error:
            self._fail(each, f"seed {planned.seed}: {error}")
            return
        self._failures = None
        before = self.queue.known_figure
        if before is None:
            self.place.study.set_user_attr(JUDGED_BY, outcome.name)
        elif before != outcome.name:  # after an update, an optimum may be known
            raise UserError(
                f"{self.tuning.study.name}: runs there were judged by {before}, and now by "
                f"{outcome.name}: --name NAME makes a search of its own"
            )
        each.figures[planned.seed] = outcome.figure
        each.seconds += outcome.seconds
        with _lost_to_others():
            step = len(each.figures)
            there = self.queue.storage.get_trial(each.trial._trial_id).intermediate_values
            if step not in there:  # a killed driver may have reported it
                each.trial.report(self._value(each), step)
            each.trial.set_user_attr(SECONDS, each.seconds)
            if outcome.steps is not None:
                each.steps[planned.seed] = outcome.steps
                steps = {str(seed): steps for seed, steps in each.steps.items()}
                each.trial.set_user_attr(AT_OPTIMUM, steps)
            # Last, because it marks the seed as done.
            figures = {str(seed): figure for seed, figure in each.figures.items()}
            each.trial.set_user_attr(FIGURES, figures)
        self._judge(each)

    def _value(self, each: TrialUnderWay) -> float:
        figures = list(each.figures.values())
        return judged(figures, self.tuning.objective, is_cost=self.tuning.is_cost)

    def _judge(self, each: TrialUnderWay) -> None:
        """End a trial that is complete or hopeless."""
        if len(each.figures) == len(self.tuning.seeds):
            self._end(each, self._value(each), "")
        elif each.trial.number and self.place.hopeless(each.trial.number, each.figures):
            self._end(each, None, "")

    def _fail(self, each: TrialUnderWay, reason: str) -> None:
        """End a trial with a failed run; samplers treat it as one of the worst."""
        with _lost_to_others():
            each.trial.set_user_attr(FAILURE, reason)
        self._end(each, None, reason)
        if self._failures is not None:
            self._failures.append(reason)
            if len(self._failures) >= MOST_FAILURES:
                raise UserError(f"all of the first {MOST_FAILURES} trials failed; {reason}")

    def _end(self, each: TrialUnderWay, value: float | None, reason: str) -> None:
        """End a trial; without a value if it was pruned or failed."""
        state = TrialState.PRUNED if value is None else TrialState.COMPLETE
        with _lost_to_others():
            self.place.study.tell(each.trial, value, state, skip_if_finished=True)
        each.is_over = True
        self._trials.remove(each)
        for future, (other, _) in self._runs.items():
            if other is each:
                future.cancel()  # running ones continue, and their folders stay
        self.listener.trial_ended(each.trial.number, value, reason)


def _check_room(root: Path) -> None:
    """Raise UserError if the disk is full: then a run did not fail because of its settings."""
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
    """Ignore errors about a trial that another driver took after this driver's time-out."""
    with contextlib.suppress(UpdateFinishedTrialError, ValueError):
        yield
