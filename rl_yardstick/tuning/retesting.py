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
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import numpy as np
import yaml
from optuna.trial import FrozenTrial, TrialState

from rl_yardstick.envs.brackets import upper_is_proven
from rl_yardstick.experiments.analysis import StudyAnalysis
from rl_yardstick.experiments.study import METRICS, AgentSpec, Metric, StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import plain, write_json, write_text
from rl_yardstick.pipeline.settings import TUNED_ON, seeds_tuned_on
from rl_yardstick.tuning.searching import ASKED, FAILURE, SETTINGS, Search, outcome_of, outcomes_of
from rl_yardstick.tuning.tuning_spec import SHIPPED, STEPS, TuningSpec
from rl_yardstick.verdicts import Estimate, Pair, Study, judge, mean_over_runs

FOLDER, WINNER, RECORD = "retest", "winner.yml", "tuning.json"


def label_of(trial: FrozenTrial) -> str:
    """The label of a trial's settings in the re-test."""
    return f"trial {trial.number}" if trial.number else SHIPPED


def figures_of(trial: FrozenTrial) -> Floats:
    """The figures of a trial on its seeds."""
    return np.array([run.figure for run in outcomes_of(trial).values()])


def best_trials(tuning: TuningSpec, trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """The complete trials, best first; equal ones in their order.

    Trials with the optimum on all seeds are ordered by their steps to the threshold. Of several
    with the same settings, the first is taken.
    """
    found: list[FrozenTrial] = []
    for trial in trials:
        known = [each.user_attrs[SETTINGS] for each in found]
        if trial.state == TrialState.COMPLETE and trial.user_attrs[SETTINGS] not in known:
            found.append(trial)

    def order(trial: FrozenTrial) -> tuple[float, float]:
        steps = [run.steps for run in outcomes_of(trial).values()]
        if None not in steps:
            return -math.inf, fmean(step or 0.0 for step in steps)
        return (1 if tuning.is_cost else -1) * tuning.value(figures_of(trial)), 0.0

    return sorted(found, key=order)


def chosen_for_retest(tuning: TuningSpec, ranked: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """The best trials, without those that are clearly below the shipped settings in the search.

    The shipped settings are not among them: they are re-tested anyway.
    """
    shipped = [figures_of(trial) for trial in ranked if not trial.number]
    best = [trial for trial in ranked if trial.number][: tuning.retest]
    return [t for t in best if not any(_is_below(tuning, figures_of(t), one) for one in shipped)]


def _is_below(tuning: TuningSpec, one: Floats, other: Floats) -> bool:
    """Whether a mean in the search is lower by over two standard errors of the difference."""
    if min(len(one), len(other)) < 2:
        return False
    error = math.sqrt(sum(each.var(ddof=1) / len(each) for each in (one, other)))
    return bool((one.mean() - other.mean()) * (1 if tuning.is_cost else -1) > 2 * error)


def retest_study(tuning: TuningSpec, root: Path, trials: Sequence[FrozenTrial]) -> StudySpec:
    """Make the study of the re-test; the file of each setting names its tuning seeds."""
    agents = [tuning.agent]
    for trial in trials:
        path = root / FOLDER / f"trial-{trial.number}.yml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, entry_text(tuning, trial.user_attrs[SETTINGS]))
        agents.append(AgentSpec(label_of(trial), tuning.agent.algo, conf_file=path))
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
    words = {name: pair.word for name, pair in _against_shipped(said).items()}
    may_win = [one for one in said.agents if words.get(one.name) in ("better", "undecided")]
    whole = [one for one in may_win if not one.n_missing]
    best = max(whole, key=lambda one: one.mean, default=None)
    return best is not None and words[best.name] == "better"


def _against_shipped(said: Study) -> dict[str, Pair]:
    pairs = [one for pair in said.pairs for one in (pair, pair.swapped())]
    return {pair.first: pair for pair in pairs if pair.second == SHIPPED}


# --- the result -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Retested:
    """The result of one setting on held-out seeds."""

    label: str
    number: int  # number of its trial; 0 for the shipped settings
    in_search: float | None  # its value in the search, if its trial is complete
    held_out: float | None  # its value on held-out seeds; None without runs
    interval: Estimate | None  # the mean of its figures there, with its interval
    verdict: str  # its word against the shipped settings; empty for these
    n_runs: int
    # Failed runs, with a score below half the best median; None if that is not defined.
    n_failed: int | None
    n_missing: int = 0
    gain: tuple[float, float, float] | None = None  # over the shipped settings; its interval


@dataclass(frozen=True)
class Outcome:
    """The result of a search."""

    retested: tuple[Retested, ...]  # the shipped settings, then the others, best first
    # The best of the others with runs on all held-out seeds and a verdict that it is better than
    # the shipped settings.
    winner: Retested | None
    reason: str  # why there is no winner; empty if there is one
    # How much better the best setting of the search was in the search than on held-out seeds; None
    # if it was not re-tested.
    optimism: float | None
    held_out: range  # the held-out seeds; in a growing re-test, some settings may have fewer


def concluded(
    tuning: TuningSpec,
    ranked: Sequence[FrozenTrial],
    chosen: Sequence[FrozenTrial],
    analysis: StudyAnalysis,
) -> Outcome:
    """The result of the re-test of the ``chosen`` trials; ``ranked`` are all complete ones."""
    # As in the verdicts of a study, a score below 0 counts as 0.
    is_score = tuning.figure == "score" and all(each.is_score for each in analysis.environments)
    least = 0.0 if is_score and tuning.objective == "mean" else -math.inf
    in_search = {t.number: tuning.value(np.maximum(figures_of(t), least)) for t in ranked}
    numbers = {SHIPPED: 0} | {label_of(trial): trial.number for trial in chosen}
    found: dict[str, list[float]] = {label: [] for label in numbers}
    for run in analysis.results.planned:
        with suppress(UserError):  # the study reports missing runs and their reasons
            found[run.agent].append(outcome_of(tuning, run).figure)
    figures = {label: np.maximum(values, least) for label, values in found.items()}
    said = analysis.verdicts
    if tuning.figure == STEPS:  # which the study does not compare
        scores = {SHIPPED: {label: -values for label, values in figures.items()}}
        said = judge(scores, margin=0, baseline=None, against=SHIPPED)
    pairs = _against_shipped(said)
    agents = {each.agent: each for one in analysis.environments for each in one.agents}
    retested = [
        Retested(
            label=label,
            number=number,
            in_search=in_search.get(number),
            held_out=tuning.value(figures[label]) if len(figures[label]) else None,
            interval=mean_over_runs(figures[label]) if len(figures[label]) else None,
            verdict=pairs[label].text if label in pairs else "",
            gain=(pairs[label].difference, *pairs[label].interval) if label in pairs else None,
            n_runs=agents[label].n_runs if label in agents else 0,
            n_failed=agents[label].runs.failed if label in agents else None,
            n_missing=agents[label].n_missing if label in agents else 0,
        )
        for label, number in numbers.items()
    ]
    best = next((each for each in retested if ranked and each.number == ranked[0].number), None)
    optimism = None
    if best is not None and best.in_search is not None and best.held_out is not None:
        optimism = (best.in_search - best.held_out) * (-1 if tuning.is_cost else 1)
    n_seeds = max(each.n_runs + each.n_missing for each in retested)
    held_out = range(tuning.first_retest_seed, tuning.first_retest_seed + n_seeds)
    return Outcome(tuple(retested), *_winner(tuning, retested), optimism, held_out)


def _winner(tuning: TuningSpec, retested: Sequence[Retested]) -> tuple[Retested | None, str]:
    """The best setting that the verdict calls better than the shipped ones, or why there is none.

    A setting with missing runs is excluded, because its remaining runs may be the luckier ones.
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
    """The text of a file with one entry in the format of `hyperparams/`, below a comment.

    Its tuning seeds are the search's own, and those of the shipped settings.
    """
    agent, env_id = tuning.agent, tuning.environment.env_id
    before = seeds_tuned_on(agent.algo, env_id, agent.conf_file) or ()
    used = dict.fromkeys([*before, tuning.study.seeds])
    seeds = [{"first": each.start, "count": len(each)} for each in used]
    lines = textwrap.wrap(comment, 100, initial_indent="# ", subsequent_indent="# ")
    tuned_on, found = (
        yaml.safe_dump(plain(data), sort_keys=False, allow_unicode=True)
        for data in ({TUNED_ON: {env_id: seeds}}, {env_id: entry})
    )
    return tuned_on + "\n".join(["", *lines, ""]) + found


def write_winner(search: Search, outcome: Outcome) -> Path | None:
    """Write the winner's entry for `hyperparams/` and ``--conf-file``; returns the file, if any.

    A comment in it has the origin of the settings.
    """
    path, tuning, winner = search.root / WINNER, search.tuning, outcome.winner
    if winner is None:
        path.unlink(missing_ok=True)  # from before the search continued
        return None
    entry = search.trials[winner.number].user_attrs[SETTINGS]
    seeds, held_out = tuning.study.seeds, outcome.held_out
    n_others = len(outcome.retested) - 1
    chosen = f", the best of {n_others} that were run again" if n_others > 1 else ""
    comment = (
        f"Tuned by tune.py on {time.strftime('%Y-%m-%d')}: trial {winner.number} of "
        f"{tuning.n_trials} ({tuning.sampler}), {tuning.objective} of {tuning.figure}"
        f"{unproven_mark(tuning)} over the seeds {seeds.start} to {seeds.stop - 1}: "
        f"{winner.in_search:.4g}. On the seeds {held_out.start} to {held_out.stop - 1}, which the "
        f"search has not seen{chosen}: {winner.held_out:.4g} ({winner.n_runs} runs); the settings "
        f"before, there: {outcome.retested[0].held_out:.4g}. Verdict on means: {winner.verdict}."
    )
    if tuning.searched(entry) != dict(entry):
        comment += " The search ran with engine: auto, the re-test in the engine of train.py."
    write_text(path, entry_text(tuning, entry, comment))
    return path


def unproven_mark(tuning: TuningSpec) -> str:
    """A note on scores whose optimum is an unproven upper bound; empty for other figures."""
    is_proven = tuning.figure != "score" or upper_is_proven(tuning.environment.env_id)
    return "" if is_proven else " by a bracket whose upper end is not proven"


# --- the record of the search ---------------------------------------------------------------------


def write_record(search: Search, outcome: Outcome | None, command: str) -> dict[str, Any]:
    """Write the record of the search to ``tuning.json``, and return it for the page."""
    tuning, shipped = search.tuning, search.suggestions.shipped
    first, n_seeds = tuning.first_retest_seed, tuning.retest_seeds
    held_out = range(first, first + n_seeds) if outcome is None else outcome.held_out
    data: dict[str, Any] = {
        "name": tuning.study.name,
        "command": command,
        "asked": search.study.user_attrs[ASKED],
        "figure": tuning.figure,
        **({"map_name": name} if (name := tuning.environment.map_name) else {}),
        **({"figure_mark": mark} if (mark := unproven_mark(tuning)) else {}),
        "objective": tuning.objective,
        "lower_is_better": tuning.is_cost,
        "n_trials": tuning.n_trials,
        "n_at_optimum": search.n_at_optimum,
        "seeds": list(tuning.seeds),
        "held_out_seeds": list(held_out),
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
