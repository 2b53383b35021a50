"""The best settings on seeds that the search has not seen, beside those that it began with."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from experiments.plan import PlannedRun
from experiments.study import METRICS, AgentSpec, Metric, StudySpec
from pipeline.digests import DamagedFileError
from pipeline.files import write_text
from tuning.entry_files import entry_text
from tuning.judging import UnjudgedError, judged, outcome_of
from tuning.trial_queue import SETTINGS
from tuning.trial_runs import name_of
from tuning.tuning_spec import SHIPPED, TuningSpec
from verdicts import Estimate

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

FOLDER = "retest"
ROUNDING = 1e-9  # two that are the same but for this are the same


@dataclass(frozen=True)
class Candidate:
    """A setting that is run again.

    Attributes:
        number: of its trial.
        entry: its hyperparameters.
        value: what the search found it to be worth.
    """

    number: int
    entry: Mapping[str, Any]
    value: float

    @property
    def label(self) -> str:
        """What it is called in the re-test."""
        return f"trial {self.number}" if self.number else SHIPPED


def best_trials(trials: Sequence[FrozenTrial], *, is_cost: bool) -> list[Candidate]:
    """The settings that have all their seeds, the best first, the earlier where they are equal.

    Each is there once, however many trials tried it.
    """
    from optuna.trial import TrialState

    found: dict[str, Candidate] = {}
    for trial in trials:
        entry = trial.user_attrs.get(SETTINGS)
        value = trial.value if trial.state == TrialState.COMPLETE else None
        if value is not None and isinstance(entry, Mapping):
            found.setdefault(name_of(entry), Candidate(trial.number, entry, value))
    sign = 1 if is_cost else -1
    return sorted(found.values(), key=lambda each: (sign * each.value, each.number))


def chosen_for_retest(ranked: Sequence[Candidate], k: int) -> list[Candidate]:
    """The best ``k``, but for the settings that the search began with, which are run anyway."""
    return [each for each in ranked if each.number][:k]


def retest_study(tuning: TuningSpec, root: Path, candidates: Sequence[Candidate]) -> StudySpec:
    """The study that judges them, with a file for each which says what it was tuned on."""
    agents = [tuning.agent]
    for each in candidates:
        path = root / FOLDER / f"{each.label.replace(' ', '-')}.yml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, entry_text(tuning, each.entry, ()))
        agents.append(AgentSpec(each.label, tuning.agent.algo, conf_file=path))
    metric = tuning.figure if tuning.figure in METRICS else "final"  # of scores and costs too
    return replace(
        tuning.study,
        name=FOLDER,
        title=f"{tuning.agent.algo} on {tuning.environment.env_id}: "
        f"the best settings of a search, on other seeds",
        description=f"Settings that a search found on the seeds {_named(tuning.seeds)}, "
        "beside those that it began with, on seeds that it has not seen.",
        agents=tuple(agents),
        first_seed=tuning.first_retest_seed,
        n_seeds=tuning.retest_seeds,
        metric=cast(Metric, metric),
    )


def _named(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, sorted(seeds)))


@dataclass(frozen=True)
class Retested:
    """What one of the settings came to on other seeds.

    Attributes:
        label: what it is called.
        number: of its trial; 0 for the settings that the search began with.
        in_search: what the search found it to be worth; None where it was not judged to the end.
        held_out: the same on the other seeds; None where no run is there.
        interval: the mean of the scores there, or of what was asked for instead, with its interval.
        verdict: on it beside the settings that the search began with; empty for these.
        n_runs: how many runs there are.
        n_failed: how many of them got less than half as far as the best typical run; None where
            nothing says what that is.
    """

    label: str
    number: int
    in_search: float | None
    held_out: float | None
    interval: Estimate
    verdict: str
    n_runs: int
    n_failed: int | None


@dataclass(frozen=True)
class Outcome:
    """What a tuning comes to.

    Attributes:
        retested: the settings that the search began with, then the others, the best in the search
            first.
        winner: of the others that ran on all other seeds, the best there, where it is better than
            those that the search began with, and no verdict says otherwise; None where none is.
        optimism: by how much the best of the search was better there than on the other seeds; None
            where it was not run again.
        reason: why there is no winner; empty where there is one.
    """

    retested: tuple[Retested, ...]
    winner: Retested | None
    optimism: float | None
    reason: str


def concluded(
    tuning: TuningSpec,
    ranked: Sequence[Candidate],
    candidates: Sequence[Candidate],
    analysis: StudyAnalysis,
) -> Outcome:
    """What the re-test shows.

    Args:
        tuning: what was asked for.
        ranked: all settings that the search judged to the end, the best first.
        candidates: those that were run again.
        analysis: the study of these.
    """
    judged_there = {each.number: each.value for each in ranked}
    numbers = {SHIPPED: 0} | {each.label: each.number for each in candidates}
    environment = analysis.environments[0] if analysis.environments else None
    retested = [
        _retested(tuning, label, number, judged_there.get(number), analysis, environment)
        for label, number in numbers.items()
    ]
    winner, reason = _winner(tuning, retested)
    best = ranked[0].number if ranked else None
    found = next((each for each in retested if each.number == best), None)
    return Outcome(
        tuple(retested), winner, None if found is None else optimism(tuning, found), reason
    )


def optimism(tuning: TuningSpec, best: Retested) -> float | None:
    """By how much a setting looked better in the search than it is; above 0 where it did."""
    if best.in_search is None or best.held_out is None:
        return None
    apart = best.in_search - best.held_out
    return -apart if tuning.is_cost else apart


def _retested(
    tuning: TuningSpec,
    label: str,
    number: int,
    in_search: float | None,
    analysis: StudyAnalysis,
    environment: EnvironmentAnalysis | None,
) -> Retested:
    runs = [run for run in analysis.results.planned if run.agent == label]
    figures = _figures(tuning, runs)
    held_out = judged(figures, tuning.objective, is_cost=tuning.is_cost) if figures else None
    agent = _of_label(environment, label)
    return Retested(
        label=label,
        number=number,
        in_search=in_search,
        held_out=held_out,
        interval=_interval(tuning, agent),
        verdict="" if number == 0 else _verdict(environment, label),
        n_runs=0 if agent is None else agent.n_runs,
        n_failed=_n_failed(environment, label),
    )


def _n_failed(environment: EnvironmentAnalysis | None, label: str) -> int | None:
    count = None if environment is None else environment.failures.get(label)
    return None if count is None else count.n_failed


def _figures(tuning: TuningSpec, runs: Sequence[PlannedRun]) -> list[float]:
    figures = []
    for run in runs:
        try:
            figures.append(outcome_of(tuning, run).figure)
        except (UnjudgedError, DamagedFileError):
            continue  # the study says which runs are not there, and why
    return figures


def _of_label(environment: EnvironmentAnalysis | None, label: str) -> AgentAnalysis | None:
    agents = () if environment is None else environment.agents
    return next((agent for agent in agents if agent.agent == label), None)


def interval_of(tuning: TuningSpec) -> str:
    """What the intervals are of: there are none for quartiles and times to a threshold."""
    statistic = "interquartile mean" if tuning.objective == "iqm" else "mean"
    return f"{statistic} of {tuning.figure if tuning.figure in METRICS else 'score'}"


def _interval(tuning: TuningSpec, agent: AgentAnalysis | None) -> Estimate:
    if agent is None:
        return Estimate(math.nan, math.nan, math.nan, 0)
    is_score = tuning.figure in ("score", "steps", "seconds") and agent.score is not None
    summary = agent.score if is_score and agent.score is not None else agent.metric
    return summary.iqm if tuning.objective == "iqm" else summary.mean


def _verdict(environment: EnvironmentAnalysis | None, label: str) -> str:
    for pair in () if environment is None else environment.pairs:
        if (pair.first, pair.second) == (label, SHIPPED):
            return pair.verdict
        if (pair.first, pair.second) == (SHIPPED, label):
            return pair.swapped().verdict
    return "undecided"


def _winner(tuning: TuningSpec, retested: Sequence[Retested]) -> tuple[Retested | None, str]:
    """The best on other seeds, unless it is no better there than what the search began with.

    Where runs of it failed it is out: those that are left are the luckier ones.
    """
    shipped, *others = retested
    there = [each for each in others if each.n_runs >= tuning.retest_seeds]
    if not there:
        return None, "none has run on all other seeds"
    sign = -1 if tuning.is_cost else 1
    best = max(there, key=lambda each: sign * (each.held_out or 0.0))
    if shipped.held_out is None:
        return None, "the shipped settings did not run"
    apart = sign * ((best.held_out or 0.0) - shipped.held_out)
    if best.verdict == "worse" or apart <= ROUNDING * abs(shipped.held_out):
        return None, "none is better than the shipped settings on other seeds"
    return best, ""
