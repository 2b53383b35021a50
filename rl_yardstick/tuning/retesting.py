"""Re-tests the best settings on held-out seeds, and writes the result files of a search.

The best settings and the initial settings of the search run in a normal study. If a setting is
better there, it is written as an entry of hyperparameters; ``tuning.json`` has all figures.
"""

from __future__ import annotations

import contextlib
import math
import textwrap
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from optuna.trial import FrozenTrial, TrialState

from rl_yardstick.envs.brackets import upper_is_proven
from rl_yardstick.experiments.analysis import StudyAnalysis
from rl_yardstick.experiments.study import METRICS, AgentSpec, Metric, StudySpec
from rl_yardstick.pipeline.digests import DamagedFileError
from rl_yardstick.pipeline.files import plain, write_json, write_text
from rl_yardstick.pipeline.settings.hyperparams import TUNED_ON, seeds_tuned_on
from rl_yardstick.tuning.searching import OpenTuning, UnjudgedError, outcome_of
from rl_yardstick.tuning.suggesting import name_of
from rl_yardstick.tuning.trial_storage import (
    ASKED,
    AT_OPTIMUM,
    FAILURE,
    SETTINGS,
    figures_of,
    seconds_of,
)
from rl_yardstick.tuning.tuning_spec import COST_OF_THRESHOLD, SHIPPED, Floats, TuningSpec, judged
from rl_yardstick.verdicts import Estimate, Study, judge, mean_over_runs

FOLDER, WINNER, RECORD = "retest", "winner.yml", "tuning.json"

LONGEST_LINE = 100
LIBRARY_LOOP = "Stable-Baselines3's own loop, in which the agent trains unless told otherwise"


@dataclass(frozen=True)
class Candidate:
    """A setting in the re-test."""

    number: int  # number of its trial
    entry: Mapping[str, Any]  # its hyperparameters
    value: float  # its value in the search
    figures: tuple[float, ...] = ()  # its figure on each seed of the search
    steps: float | None = None  # mean steps to the threshold, if it has the optimum on all seeds

    @property
    def label(self) -> str:
        """Its label in the re-test."""
        return f"trial {self.number}" if self.number else SHIPPED


def best_trials(trials: Sequence[FrozenTrial], *, is_cost: bool) -> list[Candidate]:
    """The settings of complete trials, best first; equal ones in order of their trials.

    Settings with the optimum on all seeds are ordered by their steps to the threshold. A setting of
    several trials appears once.
    """
    found: dict[str, Candidate] = {}
    for trial in trials:
        said, entry = trial.user_attrs, trial.user_attrs.get(SETTINGS)
        value = trial.value if trial.state == TrialState.COMPLETE else None
        if value is not None and isinstance(entry, Mapping):
            figures = tuple(figures_of(said).values())
            steps = [*figures_of(said, AT_OPTIMUM).values()]
            mean = sum(steps) / len(steps) if steps and len(steps) == len(figures) else None
            found.setdefault(name_of(entry), Candidate(trial.number, entry, value, figures, mean))

    def order(each: Candidate) -> tuple[float, float]:
        if each.steps is not None:
            return -1.0, each.steps
        return (1 if is_cost else -1) * each.value, 0.0

    return sorted(found.values(), key=order)


def chosen_for_retest(ranked: Sequence[Candidate], k: int, *, is_cost: bool) -> list[Candidate]:
    """The best ``k`` settings, without those that are clearly below the initial ones in the search.

    The initial settings are not among them: they are re-tested anyway.
    """
    shipped = next((each for each in ranked if not each.number), None)
    best = [each for each in ranked if each.number][:k]
    return [each for each in best if shipped is None or not _is_below(each, shipped, is_cost)]


def _is_below(one: Candidate, other: Candidate, is_cost: bool) -> bool:
    """Whether its mean in the search is lower by over two standard errors of the difference."""
    first, second = np.array(one.figures), np.array(other.figures)
    if min(len(first), len(second)) < 2:
        return False
    error = math.sqrt(sum(each.var(ddof=1) / len(each) for each in (first, second)))
    return bool((first.mean() - second.mean()) * (1 if is_cost else -1) > 2 * error)


def retest_study(tuning: TuningSpec, root: Path, candidates: Sequence[Candidate]) -> StudySpec:
    """Make the study of the re-test; the file of each setting names its tuning seeds."""
    agents = [tuning.agent]
    for each in candidates:
        path = root / FOLDER / f"{each.label.replace(' ', '-')}.yml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, entry_text(tuning, each.entry, ()))
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
    """Whether the best setting of a growing re-test is shown to be better than the initial one.

    Settings that are shown not to be better, and those with missing runs, do not count.
    """
    runs = {(one.environment, one.name): one for one in said.agents}
    for environment in said.best:
        pairs = [pair for pair in said.pairs if pair.environment == environment]
        words = {p.first: p.word for pair in pairs for p in (pair, pair.swapped())}
        words.pop(SHIPPED, None)
        there = [
            runs[environment, name]
            for name, word in words.items()
            if word in ("better", "undecided") and not runs[environment, name].n_missing
        ]
        best = max(there, key=lambda one: one.mean, default=None)
        if best is None or words[best.name] != "better":
            return False
    return True


@dataclass(frozen=True)
class Retested:
    """The result of one setting on held-out seeds."""

    label: str  # its label
    number: int  # number of its trial; 0 for the initial settings
    in_search: float | None  # its value in the search, if its trial is complete
    held_out: float | None  # its value on held-out seeds; None without runs
    interval: Estimate | None  # the mean of its figures with its interval; None without runs
    verdict: str  # its word against the initial settings; empty for the initial settings
    n_runs: int  # number of runs
    # Number of failed runs, with a score below half the best median; None if that is not defined.
    n_failed: int | None
    n_missing: int = 0  # number of runs that are missing


@dataclass(frozen=True)
class Outcome:
    """The result of a tuning."""

    # The initial settings, then the others, best in the search first.
    retested: tuple[Retested, ...]
    # The best of the other settings with runs on all held-out seeds and a verdict that it is better
    # than the initial settings.
    winner: Retested | None
    # How much better the best setting of the search was in the search than on held-out seeds; None
    # if it was not re-tested.
    optimism: float | None
    reason: str  # why there is no winner; empty if there is one
    held_out: range  # the held-out seeds; in a growing re-test, some settings may have fewer


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
    in_search = {each.number: _value(tuning, each.figures, least) for each in ranked}
    numbers = {SHIPPED: 0} | {each.label: each.number for each in candidates}
    figures = {label: np.maximum(_figures(tuning, label, analysis), least) for label in numbers}
    words = _words(tuning, figures, analysis)
    retested = [
        _retested(tuning, label, number, in_search.get(number), figures[label], words, analysis)
        for label, number in numbers.items()
    ]
    winner, reason = _winner(tuning, retested)
    best = [each for each in retested if ranked and each.number == ranked[0].number]
    fooled_by = optimism(tuning, best[0]) if best else None
    n_seeds = max(each.n_runs + each.n_missing for each in retested)
    held_out = range(tuning.first_retest_seed, tuning.first_retest_seed + n_seeds)
    return Outcome(tuple(retested), winner, fooled_by, reason, held_out)


def _value(tuning: TuningSpec, figures: Sequence[float] | Floats, least: float) -> float:
    values = np.maximum(np.asarray(figures, np.float64), least)
    return judged(values, tuning.objective, is_cost=tuning.is_cost)


def optimism(tuning: TuningSpec, best: Retested) -> float | None:
    """The optimism of the search: positive if the setting was worse on held-out seeds."""
    if best.in_search is None or best.held_out is None:
        return None
    apart = best.in_search - best.held_out
    return -apart if tuning.is_cost else apart


def _figures(tuning: TuningSpec, label: str, analysis: StudyAnalysis) -> Floats:
    figures = []
    for run in analysis.results.planned:
        # The study reports missing runs and their reasons.
        with contextlib.suppress(UnjudgedError, DamagedFileError):
            if run.agent == label:
                figures.append(outcome_of(tuning, run).figure)
    return np.array(figures)


def _retested(
    tuning: TuningSpec,
    label: str,
    number: int,
    in_search: float | None,
    figures: Floats,
    words: Mapping[str, str],
    analysis: StudyAnalysis,
) -> Retested:
    environment = next(iter(analysis.environments), None)
    agents = () if environment is None else environment.agents
    agent = next((agent for agent in agents if agent.agent == label), None)
    value = None
    if len(figures):
        value = judged(figures, tuning.objective, is_cost=tuning.is_cost)
    return Retested(
        label=label,
        number=number,
        in_search=in_search,
        held_out=value,
        interval=mean_over_runs(figures) if len(figures) else None,
        verdict=words.get(label, ""),
        n_runs=0 if agent is None else agent.n_runs,
        n_failed=None if agent is None else agent.runs.failed,
        n_missing=0 if agent is None else agent.n_missing,
    )


def _words(
    tuning: TuningSpec, figures: Mapping[str, Floats], analysis: StudyAnalysis
) -> dict[str, str]:
    """The word on each setting against the initial ones: on the mean of the searched figure.

    They are those of the re-test's study where it compares the same figure.
    """
    said = analysis.verdicts
    if tuning.figure in COST_OF_THRESHOLD:
        sign = -1.0 if tuning.is_cost else 1.0
        scores = {SHIPPED: {label: sign * values for label, values in figures.items()}}
        said = judge(scores, margin=0, baseline=None, against=SHIPPED)
    pairs = [one for pair in said.pairs for one in (pair, pair.swapped())]
    return {pair.first: pair.text for pair in pairs if pair.second == SHIPPED}


def statistic_of(tuning: TuningSpec) -> str:
    """The searched statistic in words."""
    lower = "upper quartile" if tuning.is_cost else "lower quartile"
    return {"mean": "mean", "iqm": "interquartile mean", "lower": lower}[tuning.objective]


def _winner(tuning: TuningSpec, retested: Sequence[Retested]) -> tuple[Retested | None, str]:
    """The best setting that the verdict calls better than the initial settings.

    It counts only held-out seeds. A setting with missing runs is excluded, because its remaining
    runs may be the luckier ones.
    """
    shipped, *others = retested
    enough = tuning.retest_seeds
    there = [each for each in others if each.n_runs >= enough and not each.n_missing]
    if not there:
        return None, "no setting finished all runs on held-out seeds"
    sign = -1 if tuning.is_cost else 1
    if shipped.held_out is None:
        return None, "the shipped settings did not run"
    better = [each for each in there if each.verdict.startswith("better")]
    if not better:
        return None, "no setting beat the shipped settings on held-out seeds"
    return max(better, key=lambda each: sign * (each.held_out or 0.0)), ""


# Entries of hyperparameters with their tuning seeds.


def entry_text(tuning: TuningSpec, entry: Mapping[str, Any], lines: Sequence[str]) -> str:
    """The text of a file with one entry in the format of `hyperparams/`, and lines of comments."""
    env_id = tuning.environment.env_id.partition(":")[2] or tuning.environment.env_id
    seeds = [{"first": each.start, "count": len(each)} for each in tuned_seeds(tuning)]
    said = {TUNED_ON: {env_id: seeds[0] if len(seeds) == 1 else seeds}}
    comment = "".join(f"# {line}\n" for line in lines)
    return f"{_yaml(said)}\n{comment}{_yaml({env_id: plain(entry)})}"


def tuned_seeds(tuning: TuningSpec) -> list[range]:
    """The seeds that a search has used, in as few ranges as possible.

    They are the search's own seeds, and the tuning seeds of the initial settings.
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


class _Dumper(yaml.SafeDumper):
    """Writes each setting on its own line, and lists of plain values and seeds on one line."""

    def represent_sequence(
        self, tag: str, sequence: Any, _: bool | None = None
    ) -> yaml.SequenceNode:
        are_plain = not any(isinstance(item, list | dict) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=are_plain)

    def represent_mapping(self, tag: str, mapping: Any, _: bool | None = None) -> yaml.MappingNode:
        are_seeds = mapping.keys() == {"first", "count"}
        return super().represent_mapping(tag, mapping, flow_style=are_seeds)


def _yaml(data: Mapping[str, Any]) -> str:
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True))


# The winner.


def write_winner(
    tuning: TuningSpec, root: Path, outcome: Outcome, entry: Mapping[str, Any], n_trials: int
) -> Path:
    """Write the winner's entry for `hyperparams/` and ``--conf-file``; returns the file."""
    path = root / WINNER
    write_text(path, entry_text(tuning, entry, _provenance(tuning, outcome, entry, n_trials)))
    return path


def _provenance(
    tuning: TuningSpec, outcome: Outcome, entry: Mapping[str, Any], n_trials: int
) -> list[str]:
    """Lines on the origin of the winner's settings."""
    winner, shipped = outcome.winner, outcome.retested[0]
    assert winner is not None
    seeds, held_out = tuning.study.seeds, outcome.held_out
    others = len(outcome.retested) - 1
    chosen = f", the best of {others} that were run again" if others > 1 else ""
    is_one_engine = tuning.searched(entry) == dict(entry)
    engines = f" The search ran with engine: auto, the re-test in {LIBRARY_LOOP}."
    text = (
        f"Tuned by tune.py on {time.strftime('%Y-%m-%d')}: trial {winner.number} of {n_trials} "
        f"({tuning.sampler}), {statistic_of(tuning)} of {tuning.figure}"
        f"{unproven_mark(tuning)} over the seeds {seeds.start} to {seeds.stop - 1}: "
        f"{_figure(winner.in_search)}. On the seeds {held_out.start} to {held_out.stop - 1}, which "
        f"the search has not seen{chosen}: {_held_out(winner)}; "
        f"the settings before, there: {_held_out(shipped)}. Verdict on means: {winner.verdict}."
        f"{'' if is_one_engine else engines}"
    )
    return textwrap.wrap(text, LONGEST_LINE - len("# "))


def _figure(value: float | None) -> str:
    return "nothing" if value is None else f"{value:.4g}"


def unproven_mark(tuning: TuningSpec) -> str:
    """A note on scores whose optimum is an unproven upper bound; empty for other figures."""
    is_proven = tuning.figure != "score" or upper_is_proven(tuning.environment.env_id)
    return "" if is_proven else " by a bracket whose upper end is not proven"


def _held_out(each: Retested) -> str:
    """The held-out figure, and the interval of the mean, in words."""
    found, text = each.interval, _figure(each.held_out)
    if found is None or found.low == found.high:
        return text
    ends = f"{found.low:.4g} to {found.high:.4g}"
    failed = f", {each.n_failed} of them failed" if each.n_failed else ""
    return f"{text} (95 % interval of the mean: {ends}, {each.n_runs} runs{failed})"


# The record.


def write_record(place: OpenTuning, outcome: Outcome | None, command: str) -> dict[str, Any]:
    """Write the record of the tuning to ``tuning.json``, and return it for the page."""
    tuning = place.tuning
    data: dict[str, Any] = {
        "name": tuning.study.name,
        "command": command,
        "asked": place.study.user_attrs.get(ASKED),
        "figure": tuning.figure,
        **({"map_name": name} if (name := tuning.environment.map_name) else {}),
        **({"figure_mark": mark} if (mark := unproven_mark(tuning)) else {}),
        "objective": tuning.objective,
        "lower_is_better": tuning.is_cost,
        "n_trials": place.queue.n_trials,
        "n_at_optimum": place.n_at_optimum,
        "seeds": list(tuning.seeds),
        "held_out_seeds": list(outcome.held_out if outcome else tuning.held_out),
        "search_engine": tuning.searched(place.suggestions.shipped).get("engine"),
        "engine": place.suggestions.shipped.get("engine"),
        "widened": list(place.suggestions.space.widened),
        "trials": [_trial(trial) for trial in place.queue.trials()],
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
    write_json(place.root / RECORD, data)
    return data


def _trial(trial: FrozenTrial) -> dict[str, Any]:
    said = trial.user_attrs
    began, ended = trial.datetime_start, trial.datetime_complete
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "value": trial.value,
        "params": dict(trial.params),
        "settings": said.get(SETTINGS),
        "figures": {str(seed): figure for seed, figure in figures_of(said).items()},
        "at_optimum": {str(seed): steps for seed, steps in figures_of(said, AT_OPTIMUM).items()},
        "seconds": seconds_of(said),
        "failure": said.get(FAILURE),
        "began": began and began.isoformat(),
        "ended": ended and ended.isoformat(),
    }
