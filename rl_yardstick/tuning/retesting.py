"""Re-tests the best settings on held-out seeds, and writes the result files of a search.

The best settings and the shipped ones, with which the search began, run in a normal study. If a
setting is better there, it is written as an entry of hyperparameters; ``tuning.json`` has all
figures.
"""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from optuna.trial import FrozenTrial, TrialState

from rl_yardstick.envs.brackets import upper_is_proven
from rl_yardstick.experiments.analysis import StudyAnalysis
from rl_yardstick.experiments.study import METRICS, AgentSpec, Metric, StudySpec
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import plain, write_json, write_text
from rl_yardstick.pipeline.settings import TUNED_ON, seeds_tuned_on
from rl_yardstick.tuning.searching import (
    ASKED,
    FAILURE,
    SETTINGS,
    Search,
    outcome_of,
    outcomes_of,
)
from rl_yardstick.tuning.tuning_spec import COST_OF_THRESHOLD, SHIPPED, Floats, TuningSpec
from rl_yardstick.verdicts import Estimate, Study, judge, mean_over_runs

FOLDER, WINNER, RECORD = "retest", "winner.yml", "tuning.json"


@dataclass(frozen=True)
class Candidate:
    """A setting that was judged on all seeds of a search."""

    number: int  # number of its trial
    entry: Mapping[str, Any]  # its hyperparameters
    figures: Floats  # its figure on each seed of the search
    steps: float | None = None  # mean steps to the threshold, if it has the optimum on all seeds

    @property
    def label(self) -> str:
        """Its label in the re-test."""
        return f"trial {self.number}" if self.number else SHIPPED


def best_trials(tuning: TuningSpec, trials: Sequence[FrozenTrial]) -> list[Candidate]:
    """The settings of complete trials, best first; equal ones in order of their trials.

    Settings with the optimum on all seeds are ordered by their steps to the threshold. A setting of
    several trials appears once.
    """
    found: list[Candidate] = []
    for trial in trials:
        entry, runs = trial.user_attrs.get(SETTINGS), outcomes_of(trial).values()
        if trial.state == TrialState.COMPLETE and all(each.entry != entry for each in found):
            steps = [run.steps for run in runs if run.steps is not None]
            mean = sum(steps) / len(steps) if len(steps) == len(runs) else None
            figures = np.array([run.figure for run in runs])
            found.append(Candidate(trial.number, entry, figures, mean))

    def order(each: Candidate) -> tuple[float, float]:
        if each.steps is not None:
            return -1.0, each.steps
        return (1 if tuning.is_cost else -1) * tuning.value(each.figures), 0.0

    return sorted(found, key=order)


def chosen_for_retest(tuning: TuningSpec, ranked: Sequence[Candidate]) -> list[Candidate]:
    """The best settings, without those that are clearly below the shipped ones in the search.

    The shipped settings are not among them: they are re-tested anyway.
    """
    shipped = next((each for each in ranked if not each.number), None)
    best = [each for each in ranked if each.number][: tuning.retest]
    if shipped is None:
        return best
    return [each for each in best if not _is_below(tuning, each.figures, shipped.figures)]


def _is_below(tuning: TuningSpec, one: Floats, other: Floats) -> bool:
    """Whether a mean in the search is lower by over two standard errors of the difference."""
    if min(len(one), len(other)) < 2:
        return False
    error = math.sqrt(sum(each.var(ddof=1) / len(each) for each in (one, other)))
    return bool((one.mean() - other.mean()) * (1 if tuning.is_cost else -1) > 2 * error)


def retest_study(tuning: TuningSpec, root: Path, candidates: Sequence[Candidate]) -> StudySpec:
    """Make the study of the re-test; the file of each setting names its tuning seeds."""
    agents = [tuning.agent]
    for each in candidates:
        path = root / FOLDER / f"{each.label.replace(' ', '-')}.yml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, entry_text(tuning, each.entry))
        agents.append(AgentSpec(each.label, tuning.agent.algo, conf_file=path))
    seeds = ", ".join(map(str, sorted(tuning.seeds)))
    metric = tuning.figure if tuning.figure in METRICS else "final"  # for scores and costs too
    return replace(
        tuning.study,
        name=FOLDER,
        title=f"{tuning.agent.algo} on {tuning.environment.label}: "
        f"the best settings of a search, on other seeds",
        description=f"Settings that a search found on the seeds {seeds}, beside those that it "
        "began with, on seeds that it has not seen. Each is compared with these alone.",
        agents=tuple(agents),
        first_seed=tuning.first_retest_seed,
        n_seeds=tuning.retest_seeds,
        metric=cast(Metric, metric),
        against=SHIPPED,
    )


def is_settled(said: Study) -> bool:
    """Whether the best setting of a growing re-test is shown to be better than the shipped one.

    Settings that are shown not to be better, and those with missing runs, do not count.
    """
    pairs = [pair for each in said.pairs for pair in (each, each.swapped())]
    words = {pair.first: pair.word for pair in pairs if pair.second == SHIPPED}
    there = [
        one
        for one in said.agents
        if words.get(one.name) in ("better", "undecided") and not one.n_missing
    ]
    best = max(there, key=lambda one: one.mean, default=None)
    return best is not None and words[best.name] == "better"


# --- the result -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Retested:
    """The result of one setting on held-out seeds."""

    label: str  # its label
    number: int  # number of its trial; 0 for the shipped settings
    in_search: float | None  # its value in the search, if its trial is complete
    held_out: float | None = None  # its value on held-out seeds; None without runs
    interval: Estimate | None = None  # the mean of its figures there, with its interval
    verdict: str = ""  # its word against the shipped settings; empty for these
    n_runs: int = 0  # number of runs
    # Number of failed runs, with a score below half the best median; None if that is not defined.
    n_failed: int | None = None
    n_missing: int = 0  # number of runs that are missing


@dataclass(frozen=True)
class Outcome:
    """The result of a search."""

    # The shipped settings, then the others, best in the search first.
    retested: tuple[Retested, ...]
    # The best of the others with runs on all held-out seeds and a verdict that it is better than
    # the shipped settings.
    winner: Retested | None
    # How much better the best setting of the search was in the search than on held-out seeds; None
    # if it was not re-tested.
    optimism: float | None
    reason: str  # why there is no winner; empty if there is one
    held_out: range = field(default=range(0))  # in a growing re-test, some settings may have fewer


def concluded(
    tuning: TuningSpec,
    ranked: Sequence[Candidate],
    candidates: Sequence[Candidate],
    analysis: StudyAnalysis,
) -> Outcome:
    """The result of the re-test of ``candidates``; ``ranked`` are all complete settings."""
    # As in the verdicts of a study, a score below 0 counts as 0.
    is_score = tuning.figure == "score" and all(each.is_score for each in analysis.environments)
    least = 0.0 if is_score and tuning.is_judged_by_study else -math.inf
    in_search = {each.number: tuning.value(np.maximum(each.figures, least)) for each in ranked}
    numbers = {SHIPPED: 0} | {each.label: each.number for each in candidates}
    figures = {label: np.maximum(_figures(tuning, label, analysis), least) for label in numbers}
    words = _words(tuning, figures, analysis)
    agents = {each.agent: each for one in analysis.environments for each in one.agents}
    retested = []
    for label, number in numbers.items():
        values, agent = figures[label], agents.get(label)
        one = Retested(label, number, in_search.get(number), verdict=words.get(label, ""))
        if len(values):
            one = replace(one, held_out=tuning.value(values), interval=mean_over_runs(values))
        if agent is not None:
            counts = {"n_runs": agent.n_runs, "n_missing": agent.n_missing}
            one = replace(one, **counts, n_failed=agent.runs.failed)
        retested.append(one)
    winner, reason = _winner(tuning, retested)
    best = next((each for each in retested if ranked and each.number == ranked[0].number), None)
    optimism = None
    if best is not None and best.in_search is not None and best.held_out is not None:
        optimism = (best.in_search - best.held_out) * (-1 if tuning.is_cost else 1)
    n_seeds = max(each.n_runs + each.n_missing for each in retested)
    held_out = range(tuning.first_retest_seed, tuning.first_retest_seed + n_seeds)
    return Outcome(tuple(retested), winner, optimism, reason, held_out)


def _figures(tuning: TuningSpec, label: str, analysis: StudyAnalysis) -> Floats:
    figures = []
    for run in analysis.results.planned:
        with suppress(UserError):  # the study reports missing runs and their reasons
            if run.agent == label:
                figures.append(outcome_of(tuning, run).figure)
    return np.array(figures)


def _words(
    tuning: TuningSpec, figures: Mapping[str, Floats], analysis: StudyAnalysis
) -> dict[str, str]:
    """The word on each setting against the shipped ones: on the mean of the searched figure.

    They are those of the re-test's study where it compares the same figure.
    """
    said = analysis.verdicts
    if tuning.figure in COST_OF_THRESHOLD:
        scores = {SHIPPED: {label: -values for label, values in figures.items()}}
        said = judge(scores, margin=0, baseline=None, against=SHIPPED)
    pairs = [one for pair in said.pairs for one in (pair, pair.swapped())]
    return {pair.first: pair.text for pair in pairs if pair.second == SHIPPED}


def _winner(tuning: TuningSpec, retested: Sequence[Retested]) -> tuple[Retested | None, str]:
    """The best setting that the verdict calls better than the shipped settings.

    It counts only held-out seeds. A setting with missing runs is excluded, because its remaining
    runs may be the luckier ones.
    """
    shipped, *others = retested
    there = [one for one in others if one.n_runs >= tuning.retest_seeds and not one.n_missing]
    if not there:
        return None, "no setting finished all runs on held-out seeds"
    if shipped.held_out is None:
        return None, "the shipped settings did not run"
    better = [each for each in there if each.verdict.startswith("better")]
    if not better:
        return None, "no setting beat the shipped settings on held-out seeds"
    sign = -1 if tuning.is_cost else 1
    return max(better, key=lambda each: sign * (each.held_out or 0.0)), ""


# --- entries of hyperparameters, with their tuning seeds ------------------------------------------


def entry_text(tuning: TuningSpec, entry: Mapping[str, Any], comment: str = "") -> str:
    """The text of a file with one entry in the format of `hyperparams/`, below a comment."""
    env_id = tuning.environment.env_id
    seeds = [{"first": each.start, "count": len(each)} for each in tuned_seeds(tuning)]
    lines = [f"{TUNED_ON}:", f"  {env_id}: {_flow(seeds)}", ""]
    lines += textwrap.wrap(comment, 100, initial_indent="# ", subsequent_indent="# ")
    lines += [f"{env_id}:", *(f"  {key}: {_flow(value)}" for key, value in entry.items())]
    return "\n".join([*lines, ""])


def _flow(value: Any) -> str:
    """A value as YAML on one line."""
    options = {"default_flow_style": True, "sort_keys": False, "allow_unicode": True}
    return str(yaml.safe_dump([plain(value)], width=math.inf, **options)).strip()[1:-1]


def tuned_seeds(tuning: TuningSpec) -> list[range]:
    """The seeds that a search has used, in as few ranges as possible.

    They are the search's own seeds, and the tuning seeds of the shipped settings.
    """
    agent = tuning.agent
    before = seeds_tuned_on(agent.algo, tuning.environment.env_id, agent.conf_file) or ()
    joined: list[range] = []
    for each in sorted([*before, tuning.study.seeds], key=lambda seeds: seeds.start):
        if joined and each.start <= joined[-1].stop:
            joined[-1] = range(joined[-1].start, max(joined[-1].stop, each.stop))
        elif each:
            joined.append(each)
    return joined


def write_winner(search: Search, outcome: Outcome, entry: Mapping[str, Any]) -> Path:
    """Write the winner's entry for `hyperparams/` and ``--conf-file``; returns the file."""
    path = search.root / WINNER
    write_text(path, entry_text(search.tuning, entry, _provenance(search, outcome, entry)))
    return path


def _provenance(search: Search, outcome: Outcome, entry: Mapping[str, Any]) -> str:
    """The origin of the winner's settings, in a few sentences."""
    tuning, winner, shipped = search.tuning, outcome.winner, outcome.retested[0]
    assert winner is not None
    lower = "upper quartile" if tuning.is_cost else "lower quartile"
    statistic = {"mean": "mean", "iqm": "interquartile mean", "lower": lower}[tuning.objective]
    seeds, held_out = tuning.study.seeds, outcome.held_out
    others = len(outcome.retested) - 1
    chosen = f", the best of {others} that were run again" if others > 1 else ""
    engines = ""
    if tuning.searched(entry) != dict(entry):
        engines = (
            " The search ran with engine: auto, the re-test in Stable-Baselines3's own loop, in "
            "which the agent trains unless told otherwise."
        )
    return (
        f"Tuned by tune.py on {time.strftime('%Y-%m-%d')}: trial {winner.number} of "
        f"{search.n_trials} ({tuning.sampler}), {statistic} of {tuning.figure}"
        f"{unproven_mark(tuning)} over the seeds {seeds.start} to {seeds.stop - 1}: "
        f"{winner.in_search:.4g}. On the seeds {held_out.start} to {held_out.stop - 1}, which the "
        f"search has not seen{chosen}: {_held_out(winner)}; the settings before, there: "
        f"{_held_out(shipped)}. Verdict on means: {winner.verdict}.{engines}"
    )


def unproven_mark(tuning: TuningSpec) -> str:
    """A note on scores whose optimum is an unproven upper bound; empty for other figures."""
    is_proven = tuning.figure != "score" or upper_is_proven(tuning.environment.env_id)
    return "" if is_proven else " by a bracket whose upper end is not proven"


def _held_out(each: Retested) -> str:
    """The held-out figure, and the interval of the mean, in words."""
    found, text = each.interval, f"{each.held_out:.4g}"
    if found is None or found.low == found.high:
        return text
    failed = f", {each.n_failed} of them failed" if each.n_failed else ""
    ends = f"{found.low:.4g} to {found.high:.4g}"
    return f"{text} (95 % interval of the mean: {ends}, {each.n_runs} runs{failed})"


# --- the record of the search ---------------------------------------------------------------------


def write_record(search: Search, outcome: Outcome | None, command: str) -> dict[str, Any]:
    """Write the record of the search to ``tuning.json``, and return it for the page."""
    tuning, shipped = search.tuning, search.suggestions.shipped
    data: dict[str, Any] = {
        "name": tuning.study.name,
        "command": command,
        "asked": search.study.user_attrs[ASKED],
        "figure": tuning.figure,
        **({"map_name": name} if (name := tuning.environment.map_name) else {}),
        **({"figure_mark": mark} if (mark := unproven_mark(tuning)) else {}),
        "objective": tuning.objective,
        "lower_is_better": tuning.is_cost,
        "n_trials": search.n_trials,
        "n_at_optimum": search.n_at_optimum,
        "seeds": list(tuning.seeds),
        "held_out_seeds": list(outcome.held_out if outcome else tuning.held_out),
        "search_engine": tuning.searched(shipped).get("engine"),
        "engine": shipped.get("engine"),
        "widened": list(search.suggestions.space.widened),
        "trials": [_trial(trial) for trial in search.trials],
        "retest": outcome
        and {
            "settings": [asdict(each) for each in outcome.retested],
            "winner": outcome.winner and outcome.winner.label,
            "winner_file": outcome.winner and WINNER,
            "reason": outcome.reason,
            "optimism": outcome.optimism,
        },
    }
    data = plain(data)
    write_json(search.root / RECORD, data)
    return data


def _trial(trial: FrozenTrial) -> dict[str, Any]:
    runs = {str(seed): run for seed, run in outcomes_of(trial).items()}
    began, ended = trial.datetime_start, trial.datetime_complete
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "value": trial.value,
        "params": dict(trial.params),
        "settings": trial.user_attrs.get(SETTINGS),
        "figures": {seed: run.figure for seed, run in runs.items()},
        "at_optimum": {seed: run.steps for seed, run in runs.items() if run.steps is not None},
        "seconds": sum(run.seconds for run in runs.values()),
        "failure": trial.user_attrs.get(FAILURE),
        "began": began and began.isoformat(),
        "ended": ended and ended.isoformat(),
    }
