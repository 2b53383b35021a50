"""A search: trials in Optuna's storage, each of which runs its seeds until it is hopeless.

The storage is the only record. A search that was killed continues by the same command: trials that
were under way are taken up again with the same settings, and their finished runs are read.

All trials use the same seeds in the same shuffled order, so that any two trials are compared seed
by seed.
"""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import optuna
from optuna import Study, Trial
from optuna.distributions import distribution_to_json
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.experiments.plan import PlannedRun, plan
from rl_yardstick.experiments.results import read_run
from rl_yardstick.pipeline.errors import UserError, as_user_error, shown
from rl_yardstick.pipeline.files import plain
from rl_yardstick.tuning import suggesting
from rl_yardstick.tuning.search_spaces import read_search_space
from rl_yardstick.tuning.suggesting import planned_runs
from rl_yardstick.tuning.tuning_spec import AUTO, STEPS, TuningSpec

OWN_FILE = "trials.log"
# If this many trials fail at the start without a success, the settings are not the reason.
MOST_FAILURES = 5
# Scores from here on are the optimum, up to rounding.
OPTIMAL_SCORE = 1 - 1e-6
# A search ends with this many settings at the optimum, or with as many as are re-tested.
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
    """Read a run's figure and its time; UserError if it has not finished, or has no such figure."""
    results = read_run(tuning.study, planned)
    if results is None:
        raise UserError("it has not finished")
    row, name = results.rows[0], tuning.figure
    if name == "score" and row.get(name) is None:  # no known optimum
        name = "final"
    figure = _steps(row) if name == STEPS else row.get(name)
    if figure is None or not math.isfinite(figure):
        hint = ": no threshold is known; give --threshold" if name == STEPS else ""
        raise UserError(f"it has no figure for {name}{hint}")
    steps = _steps(row) if name == "score" and figure >= OPTIMAL_SCORE else None
    return RunOutcome(float(figure), float(row.get("cpu_seconds") or row["seconds"]), name, steps)


def _steps(row: Mapping[str, Any]) -> float | None:
    """Steps until the learning curve reaches the threshold; None without one.

    A run that never reaches it counts as twice its length (PAR-2). If only the steps done counted,
    giving up early would look cheap.

    Source: Hutter et al. (2009), "ParamILS", JAIR 36.
    """
    if row.get("threshold") is None:
        return None
    reached = float(row["steps_to_threshold"])
    return reached if math.isfinite(reached) else 2.0 * row["n_timesteps"]


def outcomes_of(trial: FrozenTrial) -> dict[int, RunOutcome]:
    """The results of a trial's runs, by seed."""
    return {int(seed): RunOutcome(**run) for seed, run in trial.user_attrs.get(RUNS, {}).items()}


# --- hopeless trials; docs/tuning.md has the rules ------------------------------------------------

Scores = Mapping[int, float]  # by seed
Value = Callable[[Sequence[float]], float]  # of several scores

# The smallest number of seeds for a test, and the level of a test that a trial is worse than the
# best one, as in Optuna's WilcoxonPruner.
MIN_SEEDS, P_THRESHOLD = 2, 0.1
# With at least this number of seeds, a rank test can decide before most seeds are done.
SEEDS_FOR_RANKS = 10


def is_hopeless(
    scores: Scores,
    others: Sequence[Scores],
    value: Value = fmean,
    n_seeds: int | None = None,
    ceiling: float = -math.inf,
) -> bool:
    """Whether to end a trial early, by its scores and those of all others; higher is better.

    Args:
        scores: the trial's scores by seed so far.
        others: the same for ended and running trials.
        value: the value of several scores.
        n_seeds: number of seeds of a complete trial; None for the largest number so far.
        ceiling: the highest possible score; by default, the highest score so far.
    """
    n_seeds = max(map(len, others), default=0) if n_seeds is None else n_seeds
    # Running trials may have been lucky.
    whole = [each for each in others if len(each) == n_seeds]
    best = max(whole, key=lambda each: value([*each.values()]), default=None)
    if not scores or best is None:
        return False
    perfect = max(ceiling, *(max(each.values()) for each in (*others, scores) if each))
    if cannot_win(scores, best, value, n_seeds, perfect):
        return True
    return n_seeds >= SEEDS_FOR_RANKS and worse_by_ranks(scores, best)


def cannot_win(scores: Scores, best: Scores, value: Value, n_seeds: int, perfect: float) -> bool:
    """Whether the trial stays below the best one even with perfect scores on all other seeds.

    If no score is above ``perfect``, this rule never ends a trial that would have been chosen.
    """
    if (missing := n_seeds - len(scores)) <= 0:
        return False
    at_most, to_beat = value([*scores.values()] + [perfect] * missing), value([*best.values()])
    return at_most < to_beat - 1e-9 * max(1.0, abs(to_beat))


def worse_by_ranks(scores: Scores, best: Scores) -> bool:
    """Whether a signed-rank test on the common seeds finds the trial worse than the best one.

    Source: Wilcoxon (1945); as Optuna's WilcoxonPruner.
    """
    from scipy.stats import wilcoxon

    lead = [score - best[seed] for seed, score in scores.items() if seed in best]
    if len(lead) < MIN_SEEDS or sum(lead) >= 0:
        return False
    return bool(wilcoxon(lead, alternative="less", zero_method="zsplit").pvalue < P_THRESHOLD)


# --- the trials -----------------------------------------------------------------------------------


@dataclass(eq=False)
class _UnderWay:
    """A trial that has begun."""

    trial: Trial  # Optuna's trial
    to_do: list[PlannedRun] = field(default_factory=list)  # runs that have not begun, in order
    runs: dict[int, RunOutcome] = field(default_factory=dict)  # by seed
    n_running: int = 0
    is_over: bool = False  # whether further results are ignored


@dataclass(eq=False)
class Search:
    """A search with open storage: hands out runs one by one, and ends trials by their results."""

    tuning: TuningSpec
    root: Path  #: its folder
    study: Study  #: Optuna's study
    suggestions: suggesting.Suggestions  #: the settings of its trials
    #: called with the number of each trial that ends, its value (None if it was pruned or failed),
    #: and the reason of a failure
    tell: Callable[[int, float | None, str], None] = lambda *_: None
    deadline: float = math.inf  #: no run begins after this time (`time.monotonic`)
    _trials: list[_UnderWay] = field(default_factory=list)
    # Trials that wait for a run, by its folder: trials with equal settings share it.
    _waiting: dict[Path, list[_UnderWay]] = field(default_factory=dict)
    _n_failed: int | None = 0  # trials since the start; None after a success

    @property
    def trials(self) -> list[FrozenTrial]:
        """The trials so far, by number; none beyond those that were asked for."""
        return self.study.get_trials(deepcopy=False)[: self.tuning.n_trials]

    @property
    def is_done(self) -> bool:
        """Whether every trial has ended."""
        return sum(each.state.is_finished() for each in self.trials) == self.tuning.n_trials

    @property
    def n_at_optimum(self) -> int:
        """Number of settings that have the optimal score on all seeds of the search."""
        found = {
            suggesting.name_of(trial.user_attrs[SETTINGS])
            for trial in self.trials
            if (runs := outcomes_of(trial)).keys() == {*self.tuning.seeds}
            and all(run.steps is not None for run in runs.values())
        }
        return len(found)

    @property
    def is_saturated(self) -> bool:
        """Whether enough settings have the optimum on all seeds, so that the search can end."""
        return self.n_at_optimum >= max(ENOUGH_AT_OPTIMUM, self.tuning.retest)

    def next_run(self) -> PlannedRun | None:
        """The next run to do, or None while there is none.

        Trials are preferred of which no run is under way; at the end, seeds run side by side.
        """
        while time.monotonic() < self.deadline:
            open_ones = [each for each in self._trials if each.to_do]
            idle = next((each for each in open_ones if not each.n_running), None)
            busy = min(open_ones, key=lambda each: each.n_running, default=None)
            chosen = idle or self._begun() or busy
            if chosen is None:
                return None
            run = chosen.to_do.pop(0)
            waiting = self._waiting.setdefault(run.path, [])
            waiting.append(chosen)
            chosen.n_running += 1
            if len(waiting) == 1 and not run.is_finished:
                return run
            if len(waiting) == 1:
                self.ended(run, "")  # by an equal trial, or before an interruption
        return None

    def ended(self, run: PlannedRun, failure: str) -> None:
        """Take the result of a run; ``failure`` is empty if it has finished."""
        for each in self._waiting.pop(run.path):
            each.n_running -= 1
            if not each.is_over:
                self._note(each, run, failure)

    def _begun(self) -> _UnderWay | None:
        """Begin another trial, if there is one to do, or take one up again."""
        while not self.is_saturated:
            trials = self.trials
            if all(trial.state != TrialState.WAITING for trial in trials):
                if len(trials) == self.tuning.n_trials:
                    return None
                suggestions = self.suggestions
                self.study.enqueue_trial(suggestions.fixed if trials else suggestions.first)
            new = _UnderWay(self.study.ask())
            entry = self.suggestions.entry(new.trial)
            new.trial.set_user_attr(SETTINGS, plain(entry))
            self._trials.append(new)
            try:
                new.to_do = planned_runs(self.tuning, self.root, entry)
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
        self._n_failed = None
        value = self.tuning.value([one.figure for one in each.runs.values()])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a step reported before a kill
            each.trial.report(value, len(each.runs))
        each.trial.set_user_attr(RUNS, {str(k): asdict(one) for k, one in each.runs.items()})
        if len(each.runs) == len(self.tuning.seeds):
            self._end(each, value)
        elif each.trial.number and self.tuning.pruner != "none" and self._is_hopeless(each):
            self._end(each, None)

    def _is_hopeless(self, each: _UnderWay) -> bool:
        """Whether a trial can no longer be the best, by its seeds so far."""
        sign = -1.0 if self.tuning.is_cost else 1.0  # costs change their sign: higher is better
        # A score of 1 is the optimum. Without a known optimum, figures are returns, for which 1
        # means nothing.
        are_scores = any(run.name == "score" for run in each.runs.values())
        others = [outcomes_of(t) for t in self.trials if t.number != each.trial.number]
        tried = [each.runs, *others]
        own, *scores = [{s: sign * run.figure for s, run in runs.items()} for runs in tried]
        return is_hopeless(
            own,
            scores,
            lambda values: sign * self.tuning.value([sign * value for value in values]),
            n_seeds=len(self.tuning.seeds),
            ceiling=1.0 if are_scores else -math.inf,
        )

    def _fail(self, each: _UnderWay, reason: str) -> None:
        """End a trial with a failed run; samplers treat it as one of the worst."""
        each.trial.set_user_attr(FAILURE, reason)
        self._end(each, None, reason)
        if self._n_failed is not None:
            self._n_failed += 1
            if self._n_failed >= MOST_FAILURES:
                raise UserError(f"all of the first {MOST_FAILURES} trials failed; {reason}")

    def _end(self, each: _UnderWay, value: float | None, reason: str = "") -> None:
        state = TrialState.PRUNED if value is None else TrialState.COMPLETE  # or it has failed
        self.study.tell(each.trial, value, state)
        each.is_over = True
        self._trials.remove(each)
        self.tell(each.trial.number, value, reason)


# --- opening it ----------------------------------------------------------------------------------


def open_search(tuning: TuningSpec, root: Path) -> Search:
    """Check a search, and open or create its trials in its folder, which this process has locked.

    Raises UserError if the search cannot be done, or the folder has another one.
    """
    run, agent = plan(replace(tuning.study, n_seeds=1), root)[0], tuning.agent
    if tuning.figure == AUTO:
        is_bandit = ALGORITHMS[agent.algo].for_bandits
        tuning = replace(tuning, figure="regret" if is_bandit else "score")
    space = read_search_space(agent.algo, tuning.environment.env_id, tuning.search_space)
    suggestions = suggesting.Suggestions(tuning, space, suggesting.shipped_entry(run.spec))
    if not suggestions.n_free:
        raise UserError(f"{agent.algo}: its search space leaves nothing to choose")
    suggestions.check(root)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(
        study_name=tuning.study.name,
        storage=open_storage(root),
        sampler=suggesting.SeededSampler(tuning),
        pruner=optuna.pruners.NopPruner(),  # `is_hopeless` decides
        direction="minimize" if tuning.is_cost else "maximize",
        load_if_exists=True,
    )
    ranges = suggestions.space.distributions
    as_json = {name: distribution_to_json(kind) for name, kind in ranges.items()}
    asked = tuning.identity(suggestions.shipped, as_json)
    before = study.user_attrs.get(ASKED, asked)
    if changed := [key for key in asked if before.get(key) != asked[key]]:
        pairs = [(key, shown(before.get(key)), shown(asked[key])) for key in changed[:3]]
        was = "; ".join(f"{key}: {there} there, {here} now" for key, there, here in pairs)
        other = f"the search there is another ({was}): --name NAME makes one of its own"
        raise UserError(f"{tuning.study.name}: {other}")
    study.set_user_attr(ASKED, asked)
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        # Its process is gone, since this one holds the folder: Optuna hands the trial out again.
        study._storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
    return Search(tuning, root, study, suggestions)


def open_storage(root: Path) -> BaseStorage:
    """Open the journal of the trials in the search's folder, which this process has locked.

    Raises UserError if the file is damaged, or holds a study of another program.
    """
    path = root / OWN_FILE
    if path.exists():
        content = path.read_bytes()
        if whole := content.rfind(b"\n") + 1 - len(content):  # the end of a write before a kill
            os.truncate(path, len(content) + whole)
    for lock in root.glob(f"{OWN_FILE}.lock*"):
        lock.unlink()  # of a process that was killed
    with as_user_error(f"{path} is damaged", ValueError, LookupError, TypeError, AssertionError):
        storage = JournalStorage(JournalFileBackend(str(path), JournalFileOpenLock(str(path))))
        studies = storage.get_all_studies()
    for study in studies:
        if ASKED not in study.user_attrs and storage.get_n_trials(study._study_id):
            other = f"holds the Optuna study {study.study_name} of another program"
            raise UserError(f"{path} {other}: give this search another --name")
    return storage
