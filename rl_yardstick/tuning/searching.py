"""A search: trials in Optuna's storage, each of which runs its seeds until it is hopeless.

The storage is the only record. A search that was killed continues by the same command: trials that
were under way are taken up again with the same settings, and their finished runs are read.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from optuna import Study, Trial
from optuna.distributions import distribution_to_json
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.results import Curve, read_run
from rl_yardstick.pipeline.errors import UserError, one_line, shown
from rl_yardstick.pipeline.files import plain
from rl_yardstick.tuning.pruning import is_hopeless
from rl_yardstick.tuning.search_spaces import read_search_space
from rl_yardstick.tuning.suggesting import (
    Suggestions,
    make_sampler,
    name_of,
    planned_runs,
    shipped_entry,
    shipped_run,
)
from rl_yardstick.tuning.tuning_spec import AUTO, COST_OF_THRESHOLD, TuningSpec
from rl_yardstick.verdicts import steps_to_threshold

OWN_FILE = "trials.db"
SECONDS_TO_WAIT = 120  # for other users of the same database, such as a dashboard
# If this many trials fail at the start without a success, the settings are not the reason.
MOST_FAILURES = 5
# Penalty for never reaching the threshold: twice the budget (PAR-2). If only the steps done
# counted, giving up early would look cheap.
WHOLE_RUNS = 2
# Scores from here on are the optimum, up to rounding.
OPTIMAL_SCORE = 1 - 1e-6
# A search ends with this many settings at the optimum on all seeds, or with as many as are
# re-tested, if that is more.
ENOUGH_AT_OPTIMUM = 10

# Attributes of the study, and of trials beside Optuna's own data.
ASKED, SETTINGS, RUNS, FAILURE = "asked", "settings", "runs", "failure"


# --- the figure of a run --------------------------------------------------------------------------


@dataclass(frozen=True)
class RunOutcome:
    """The result of a run."""

    figure: float  # the figure for the search
    seconds: float  # its processor time
    name: str  # name of the figure: as requested, or the final return if no score is known
    steps: float | None = None  # steps to the threshold, if the score is optimal


def outcome_of(tuning: TuningSpec, planned: PlannedRun) -> RunOutcome:
    """Read the figure of a finished run, and its time.

    Raises:
        UserError: if the run has not finished, or has no such figure.
    """
    results = read_run(tuning.study, planned)
    if results is None:
        raise UserError("it has not finished")
    row, name = results.rows[0], tuning.figure
    if name == "score" and row.get(name) is None:  # no known optimum
        name = "final"
    is_cost = name in COST_OF_THRESHOLD
    figure = _cost(tuning, name, row, results.curves[0]) if is_cost else row.get(name)
    if figure is None or not math.isfinite(figure):
        raise UserError(f"it has no figure for {name}")
    steps = None
    if name == "score" and figure >= OPTIMAL_SCORE and row.get("threshold") is not None:
        steps = _cost(tuning, "steps", row, results.curves[0])
    return RunOutcome(float(figure), float(row.get("cpu_seconds") or row["seconds"]), name, steps)


def _cost(tuning: TuningSpec, name: str, row: Mapping[str, Any], evaluations: Curve) -> float:
    """Steps or seconds until the learning curve reaches the threshold.

    Source: for PAR-k, Hutter et al. (2009), "ParamILS", JAIR 36.
    """
    threshold, env_id = row.get("threshold"), tuning.environment.env_id
    if threshold is None:
        raise UserError(f"--metric {name}: no threshold is known on {env_id}; give --threshold")
    figures = evaluations.figures
    points = figures["step" if name == "steps" else "seconds"]
    reached = steps_to_threshold(points, figures["value"], float(threshold))
    whole = float(row["n_timesteps" if name == "steps" else "seconds"])
    return float(reached) if math.isfinite(reached) else WHOLE_RUNS * whole


def outcomes_of(trial: FrozenTrial) -> dict[int, RunOutcome]:
    """The results of a trial's runs, by seed."""
    return {int(seed): RunOutcome(**run) for seed, run in trial.user_attrs.get(RUNS, {}).items()}


# --- its trials -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Search:
    """A checked search with open storage."""

    tuning: TuningSpec  # its specification
    root: Path  # its folder
    study: Study  # Optuna's study
    suggestions: Suggestions  # the settings of its trials

    @property
    def n_trials(self) -> int:
        """The number of trials when the search is done."""
        return self.suggestions.n_trials

    @property
    def trials(self) -> list[FrozenTrial]:
        """The trials so far, by number; none beyond ``n_trials``."""
        return self.study.get_trials(deepcopy=False)[: self.n_trials]

    @property
    def is_done(self) -> bool:
        """Whether every trial has ended."""
        trials = self.trials
        return len(trials) == self.n_trials and all(each.state.is_finished() for each in trials)

    @property
    def n_at_optimum(self) -> int:
        """Number of settings that have the optimal score on all seeds of the search."""
        found = {
            name_of(trial.user_attrs[SETTINGS])
            for trial in self.trials
            if (runs := outcomes_of(trial)).keys() == {*self.tuning.seeds}
            and all(run.steps is not None for run in runs.values())
        }
        return len(found)

    @property
    def is_saturated(self) -> bool:
        """Whether enough settings have the optimum on all seeds, so that the search can end."""
        return self.n_at_optimum >= max(ENOUGH_AT_OPTIMUM, self.tuning.retest)

    def is_hopeless(self, number: int, runs: Mapping[int, RunOutcome]) -> bool:
        """Whether a trial can no longer be the best, by its seeds so far."""
        sign = -1.0 if self.tuning.is_cost else 1.0  # costs change their sign: higher is better

        def scores(runs: Mapping[int, RunOutcome]) -> dict[int, float]:
            return {seed: sign * run.figure for seed, run in runs.items()}

        # A score of 1 is the optimum. Without a known optimum, figures are returns, for which 1
        # means nothing.
        are_scores = any(run.name == "score" for run in runs.values())
        return is_hopeless(
            scores(runs),
            [scores(outcomes_of(trial)) for trial in self.trials if trial.number != number],
            self.tuning.pruner,
            lambda values: sign * self.tuning.value([sign * value for value in values]),
            n_seeds=len(self.tuning.seeds),
            ceiling=1.0 if are_scores else -math.inf,
        )


def open_search(tuning: TuningSpec, root: Path, storage: str | None = None) -> Search:
    """Check a search, and open or create its trials.

    Args:
        tuning: the search.
        root: its folder, which is locked by this process.
        storage: a file, or the URL of a database; None for ``trials.db`` in the folder.

    Raises:
        UserError: if the search cannot be done, or the storage has another one of this name.
    """
    run = shipped_run(tuning, root)
    agent, environment = tuning.agent, tuning.environment
    if tuning.figure == AUTO:
        is_bandit = ALGORITHMS[agent.algo].for_bandits
        tuning = replace(tuning, figure="regret" if is_bandit else "score")
    space = read_search_space(agent.algo, environment.env_id, tuning.search_space)
    suggestions = Suggestions(tuning, space, shipped_entry(run.spec))
    if not suggestions.n_free:
        raise UserError(f"{agent.algo}: its search space leaves nothing to choose")
    suggestions.check(root)
    return opened(tuning, root, suggestions, open_storage(root, storage))


def opened(
    tuning: TuningSpec, root: Path, suggestions: Suggestions, storage: BaseStorage
) -> Search:
    """Open or create the trials of a checked search."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(
        study_name=tuning.study.name,
        storage=storage,
        sampler=make_sampler(tuning),
        pruner=optuna.pruners.NopPruner(),  # `tuning.pruning` decides
        direction="minimize" if tuning.is_cost else "maximize",
        load_if_exists=True,
    )
    ranges = suggestions.space.distributions
    as_json = {name: distribution_to_json(kind) for name, kind in ranges.items()}
    asked, before = tuning.identity(suggestions.shipped, as_json), study.user_attrs.get(ASKED)
    if before is None:
        study.set_user_attr(ASKED, asked)
    elif before != asked:
        named = [key for key in asked if before.get(key) != asked[key]]
        words = "; ".join(
            f"{key}: {shown(before.get(key))} there, {shown(asked[key])} now" for key in named[:3]
        )
        raise UserError(
            f"{tuning.study.name}: the search there is another ({words}): --name NAME makes one of "
            "its own"
        )
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        # Its driver is gone, since this process holds the folder: Optuna hands it out again.
        study._storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
    return Search(tuning, root, study, suggestions)


def open_storage(root: Path, given: str | None = None) -> BaseStorage:
    """Open a storage of trials, see `open_search`."""
    if given is None:
        # Opened by path, because in a URL some characters have another meaning.
        path = root / OWN_FILE
        connect = partial(sqlite3.connect, path, SECONDS_TO_WAIT, check_same_thread=False)
        return RDBStorage(f"sqlite:///{OWN_FILE}", engine_kwargs={"creator": connect})
    if "://" in given:
        return RDBStorage(given.replace("{", "{{").replace("}", "}}"))  # Optuna replaces braces
    return JournalStorage(JournalFileBackend(given.removeprefix("journal:")))


@contextmanager
def storage_errors(name: str) -> Iterator[None]:
    """Tell a failure of the storage in one line: it is full, damaged, or cannot be reached."""
    try:
        yield
    except (SQLAlchemyError, StorageInternalError, ImportError, json.JSONDecodeError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:  # the database's own words
            cause = cause.__cause__
        reason = one_line(cause)
        raise UserError(f"{name}: {reason}; finished work is kept") from error


# --- doing them -----------------------------------------------------------------------------------


@dataclass
class _UnderWay:
    """A trial that has begun."""

    trial: Trial  # Optuna's trial
    to_do: list[PlannedRun]  # runs that have not begun, in order
    n_reported: int  # number of values that it has reported, also before it was interrupted
    runs: dict[int, RunOutcome] = field(default_factory=dict)  # by seed
    n_running: int = 0
    is_over: bool = False  # whether further results are ignored


class Trials:
    """Hands out the runs of a search one by one, and ends trials by their results.

    Args:
        search: the search.
        tell: called with the number of each trial that ends, its value (None if it was pruned or
            failed), and the reason of a failure.
        deadline: no run begins after this time (`time.monotonic`).
    """

    def __init__(
        self,
        search: Search,
        tell: Callable[[int, float | None, str], None],
        deadline: float = math.inf,
    ) -> None:
        self.search, self.tuning = search, search.tuning
        self.tell, self.deadline = tell, deadline
        self._trials: list[_UnderWay] = []
        # Trials that wait for a run, by its folder: trials with equal settings share it.
        self._waiting: dict[Path, list[_UnderWay]] = {}
        self._failures: list[str] | None = []  # since the start; None after a success

    def next_run(self) -> PlannedRun | None:
        """The next run to do, or None while there is none.

        Trials are preferred of which no run is under way; at the end, seeds run side by side.
        """
        while time.monotonic() < self.deadline:
            idle = next((each for each in self._trials if each.to_do and not each.n_running), None)
            chosen = idle or self._begun() or self._least_busy()
            if chosen is None:
                return None
            run = chosen.to_do.pop(0)
            waiting = self._waiting.setdefault(run.path, [])
            waiting.append(chosen)
            chosen.n_running += 1
            if len(waiting) > 1:
                continue
            if not run.is_finished:
                return run
            self.ended(run, "")  # by an equal trial, or before an interruption
        return None

    def ended(self, run: PlannedRun, failure: str) -> None:
        """Take the result of a run; ``failure`` is empty if it has finished."""
        for each in self._waiting.pop(run.path):
            each.n_running -= 1
            if not each.is_over:
                self._note(each, run, failure)

    def _least_busy(self) -> _UnderWay | None:
        open_ones = [each for each in self._trials if each.to_do]
        return min(open_ones, key=lambda each: each.n_running, default=None)

    def _begun(self) -> _UnderWay | None:
        """Begin another trial, if there is one to do, or take one up again."""
        study = self.search.study
        while not self.search.is_saturated:
            trials = self.search.trials
            if all(trial.state != TrialState.WAITING for trial in trials):
                if len(trials) == self.search.n_trials:
                    return None
                study.enqueue_trial(self.search.suggestions.params(len(trials)))
            trial = study.ask()
            entry = self.search.suggestions.entry(trial)
            trial.set_user_attr(SETTINGS, plain(entry))
            reported = study.get_trials(deepcopy=False)[trial.number].intermediate_values
            new = _UnderWay(trial, [], len(reported))
            self._trials.append(new)
            try:
                new.to_do = planned_runs(self.tuning, self.search.root, entry)
                return new
            except UserError as error:
                self._fail(new, str(error))
        return None

    def _note(self, each: _UnderWay, run: PlannedRun, failure: str) -> None:
        """Add a run to its trial, and end the trial if it is complete or hopeless."""
        try:
            if failure:
                raise UserError(failure)
            each.runs[run.seed] = outcome_of(self.tuning, run)
        except UserError as error:
            self._fail(each, f"seed {run.seed}: {error}")
            return
        self._failures = None
        value = self.tuning.value([one.figure for one in each.runs.values()])
        if len(each.runs) > each.n_reported:
            each.trial.report(value, len(each.runs))
        each.trial.set_user_attr(RUNS, {str(k): asdict(one) for k, one in each.runs.items()})
        number = each.trial.number
        if len(each.runs) == len(self.tuning.seeds):
            self._end(each, value)
        elif number and self.search.is_hopeless(number, each.runs):
            self._end(each, None)

    def _fail(self, each: _UnderWay, reason: str) -> None:
        """End a trial with a failed run; samplers treat it as one of the worst."""
        each.trial.set_user_attr(FAILURE, reason)
        self._end(each, None, reason)
        if self._failures is not None:
            self._failures.append(reason)
            if len(self._failures) >= MOST_FAILURES:
                raise UserError(f"all of the first {MOST_FAILURES} trials failed; {reason}")

    def _end(self, each: _UnderWay, value: float | None, reason: str = "") -> None:
        """End a trial; without a value if it was pruned or failed."""
        state = TrialState.PRUNED if value is None else TrialState.COMPLETE
        self.search.study.tell(each.trial, value, state)
        each.is_over = True
        self._trials.remove(each)
        self.tell(each.trial.number, value, reason)
