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

import yaml
from optuna.trial import FrozenTrial, TrialState

from envs.brackets import upper_is_proven
from experiments.analysis import AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from experiments.study import METRICS, AgentSpec, Metric, StudySpec
from pipeline.digests import DamagedFileError
from pipeline.files import plain, write_json, write_text
from pipeline.settings.hyperparams import TUNED_ON, seeds_tuned_on
from tuning.searching import OpenTuning, UnjudgedError, outcome_of
from tuning.suggesting import name_of
from tuning.trial_storage import ASKED, FAILURE, SETTINGS, figures_of, seconds_of
from tuning.tuning_spec import SHIPPED, TuningSpec, judged
from verdicts import Estimate

FOLDER, WINNER, RECORD = "retest", "winner.yml", "tuning.json"

LONGEST_LINE = 100
LIBRARY_LOOP = "Stable-Baselines3's own loop, in which the agent trains unless told otherwise"


@dataclass(frozen=True)
class Candidate:
    """A setting in the re-test."""

    number: int  # number of its trial
    entry: Mapping[str, Any]  # its hyperparameters
    value: float  # its value in the search

    @property
    def label(self) -> str:
        """Its label in the re-test."""
        return f"trial {self.number}" if self.number else SHIPPED


def best_trials(trials: Sequence[FrozenTrial], *, is_cost: bool) -> list[Candidate]:
    """The settings of complete trials, best first; equal ones in order of their trials.

    A setting of several trials appears once.
    """
    found: dict[str, Candidate] = {}
    for trial in trials:
        entry = trial.user_attrs.get(SETTINGS)
        value = trial.value if trial.state == TrialState.COMPLETE else None
        if value is not None and isinstance(entry, Mapping):
            found.setdefault(name_of(entry), Candidate(trial.number, entry, value))
    return sorted(found.values(), key=lambda each: each.value, reverse=not is_cost)


def chosen_for_retest(ranked: Sequence[Candidate], k: int) -> list[Candidate]:
    """The best ``k`` settings without the initial ones, which are re-tested anyway."""
    return [each for each in ranked if each.number][:k]


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
        title=f"{tuning.agent.algo} on {tuning.environment.env_id}: "
        f"the best settings of a search, on other seeds",
        description=f"Settings that a search found on the seeds {seeds}, "
        "beside those that it began with, on seeds that it has not seen.",
        agents=tuple(agents),
        first_seed=tuning.first_retest_seed,
        n_seeds=tuning.retest_seeds,
        metric=cast(Metric, metric),
    )


@dataclass(frozen=True)
class Retested:
    """The result of one setting on held-out seeds."""

    label: str  # its label
    number: int  # number of its trial; 0 for the initial settings
    in_search: float | None  # its value in the search, if its trial is complete
    held_out: float | None  # its value on held-out seeds; None without runs
    interval: Estimate  # of the mean of the held-out scores, or of the chosen objective
    verdict: str  # compared with the initial settings; empty for these
    n_runs: int  # number of runs
    # Number of failed runs, which got less than half as far as the best typical run; None if
    # that is not defined.
    n_failed: int | None


@dataclass(frozen=True)
class Outcome:
    """The result of a tuning."""

    # The initial settings, then the others, best in the search first.
    retested: tuple[Retested, ...]
    # The best of the other settings with runs on all held-out seeds and a verdict that it is better
    # than the initial settings.
    winner: Retested | None
    # By how much the best setting of the search was better there than on held-out seeds; None if
    # it was not re-tested.
    optimism: float | None
    reason: str  # why there is no winner; empty if there is one


def concluded(
    tuning: TuningSpec,
    ranked: Sequence[Candidate],
    candidates: Sequence[Candidate],
    analysis: StudyAnalysis,
) -> Outcome:
    """The result of the re-test of ``candidates``; ``ranked`` are all complete settings."""
    in_search = {each.number: each.value for each in ranked}
    numbers = {SHIPPED: 0} | {each.label: each.number for each in candidates}
    retested = [
        _retested(tuning, label, number, in_search.get(number), analysis)
        for label, number in numbers.items()
    ]
    winner, reason = _winner(tuning, retested)
    best = [each for each in retested if ranked and each.number == ranked[0].number]
    return Outcome(tuple(retested), winner, optimism(tuning, best[0]) if best else None, reason)


def optimism(tuning: TuningSpec, best: Retested) -> float | None:
    """The optimism of the search: positive if a setting looked better there than held out."""
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
) -> Retested:
    figures = []
    for run in analysis.results.planned:
        # The study reports missing runs and their reasons.
        with contextlib.suppress(UnjudgedError, DamagedFileError):
            if run.agent == label:
                figures.append(outcome_of(tuning, run).figure)
    environment = next(iter(analysis.environments), None)
    agents = () if environment is None else environment.agents
    agent = next((agent for agent in agents if agent.agent == label), None)
    failures = None if environment is None else environment.failures.get(label)
    return Retested(
        label=label,
        number=number,
        in_search=in_search,
        held_out=judged(figures, tuning.objective, is_cost=tuning.is_cost) if figures else None,
        interval=_interval(tuning, agent),
        verdict="" if number == 0 else _verdict(environment, label),
        n_runs=0 if agent is None else agent.n_runs,
        n_failed=None if failures is None else failures.n_failed,
    )


def _interval(tuning: TuningSpec, agent: AgentAnalysis | None) -> Estimate:
    if agent is None:
        return Estimate(math.nan, math.nan, math.nan, 0)
    of_score = tuning.figure in ("score", "steps", "seconds")
    summary = (agent.score if of_score else None) or agent.metric
    return summary.iqm if tuning.objective == "iqm" else summary.mean


def _verdict(environment: EnvironmentAnalysis | None, label: str) -> str:
    for pair in () if environment is None else environment.pairs:
        for seen in (pair, pair.swapped()):
            if (seen.first, seen.second) == (label, SHIPPED):
                return f"{seen.verdict}{', as seen' if seen.is_conditional else ''}"
    return "undecided"


def _winner(tuning: TuningSpec, retested: Sequence[Retested]) -> tuple[Retested | None, str]:
    """The best setting that the verdict calls better than the initial settings.

    It counts only held-out seeds. A setting with failed runs is excluded, because its remaining
    runs are the luckier ones.
    """
    shipped, *others = retested
    there = [each for each in others if each.n_runs >= tuning.retest_seeds]
    if not there:
        return None, "none has run on all other seeds"
    sign = -1 if tuning.is_cost else 1
    if shipped.held_out is None:
        return None, "the shipped settings did not run"
    better = [each for each in there if each.verdict.startswith("better")]
    if not better:
        return None, "none is shown to be better than the shipped settings on other seeds"
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
    seeds, held_out = tuning.study.seeds, tuning.held_out
    others = len(outcome.retested) - 1
    chosen = f", the best of {others} that were run again" if others > 1 else ""
    lower = "upper quartile" if tuning.is_cost else "lower quartile"
    statistic = {"mean": "mean", "iqm": "interquartile mean", "lower": lower}[tuning.objective]
    is_one_engine = tuning.searched(entry) == dict(entry)
    engines = f" The search ran with engine: auto, the re-test in {LIBRARY_LOOP}."
    text = (
        f"Tuned by tune.py on {time.strftime('%Y-%m-%d')}: trial {winner.number} of {n_trials} "
        f"({tuning.sampler}), {statistic} of {tuning.figure} over the seeds {seeds.start} to "
        f"{seeds.stop - 1}: {_figure(winner.in_search)}. On the seeds {held_out.start} to "
        f"{held_out.stop - 1}, which the search has not seen{chosen}: {_held_out(tuning, winner)}; "
        f"the settings before, there: {_held_out(tuning, shipped)}. Verdict: {winner.verdict}."
        f"{'' if is_one_engine else engines}"
    )
    return textwrap.wrap(text, LONGEST_LINE - len("# "))


def _figure(value: float | None) -> str:
    return "nothing" if value is None else f"{value:.4g}"


def unproven_mark(tuning: TuningSpec) -> str:
    """What is said of scores that go by an upper end without a proof; empty for others."""
    is_proven = tuning.figure != "score" or upper_is_proven(tuning.environment.env_id)
    return "" if is_proven else " by a bracket whose upper end is not proven"


def _held_out(tuning: TuningSpec, each: Retested) -> str:
    """The held-out figure with an interval, in words."""
    found, text = each.interval, _figure(each.held_out)
    if math.isnan(found.low):
        return text
    ends = f"{found.low:.4g} to {found.high:.4g}"
    failed = f", {each.n_failed} of them failed" if each.n_failed else ""
    # Quartiles and times to a threshold have no intervals.
    statistic = "interquartile mean" if tuning.objective == "iqm" else "mean"
    of_what = f"{statistic} of {tuning.figure if tuning.figure in METRICS else 'score'}"
    of_what += unproven_mark(tuning)
    return f"{text} (95 % interval of the {of_what}: {ends}, {each.n_runs} runs{failed})"


# The record.


def write_record(place: OpenTuning, outcome: Outcome | None, command: str) -> dict[str, Any]:
    """Write the record of the tuning to ``tuning.json``, and return it for the page."""
    tuning = place.tuning
    data: dict[str, Any] = {
        "name": tuning.study.name,
        "command": command,
        "asked": place.study.user_attrs.get(ASKED),
        "figure": tuning.figure,
        **({"figure_mark": mark} if (mark := unproven_mark(tuning)) else {}),
        "objective": tuning.objective,
        "lower_is_better": tuning.is_cost,
        "n_trials": place.queue.n_trials,
        "seeds": list(tuning.seeds),
        "held_out_seeds": list(tuning.held_out),
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
        "seconds": seconds_of(said),
        "failure": said.get(FAILURE),
        "began": began and began.isoformat(),
        "ended": ended and ended.isoformat(),
    }
