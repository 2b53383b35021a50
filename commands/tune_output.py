"""What ``tune.py`` prints of a search and its re-test, and the files that it writes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from commands.study_output import say
from pipeline.plain_runs import NETWORKS
from pipeline.signs_of_life import duration
from tuning.retesting import Outcome, Retested
from tuning.searching import OpenTuning
from tuning.suggesting import planned_run, shipped_run
from tuning.trial_storage import FAILURE, figures_of, seconds_of


def print_opened(console: Console, place: OpenTuning, where: str) -> None:
    """Say what there is to do."""
    tuning, space = place.tuning, place.suggestions.space
    n_there = sum(trial.state.is_finished() for trial in place.queue.trials())
    say(
        console,
        f"{place.queue.n_trials} trials of up to {len(tuning.seeds)} seeds, {n_there} of them "
        f"there already; {place.suggestions.n_free} settings to choose; {where}, in {place.root}",
    )
    for name in space.widened:
        say(console, f"{name}: the search space is widened to hold the shipped value")


def print_engines(console: Console, place: OpenTuning) -> None:
    """Say on which engines the search and the re-test will run, and what a run takes."""
    tuning, shipped = place.tuning, place.suggestions.shipped
    if tuning.agent.algo not in NETWORKS:
        return
    from commands.engine_lines import search_line
    from pipeline.engine_outlook import planned_outlook

    searched = planned_run(tuning, place.root, shipped, tuning.seeds[0])
    runs = (searched, shipped_run(tuning, place.root))
    line = search_line(tuning.agent.algo, *(planned_outlook(run.spec) for run in runs))
    if line:
        say(console, f"engine: {line}")


def print_search(console: Console, place: OpenTuning) -> None:
    """Say what the search has cost, and what it has found."""
    trials, tuning = place.queue.trials(), place.tuning
    states = Counter(
        "failed" if FAILURE in trial.user_attrs else _STATES.get(trial.state.name, "to do")
        for trial in trials
    )
    n_runs = sum(len(figures_of(trial.user_attrs)) for trial in trials)
    seconds = sum(seconds_of(trial.user_attrs) for trial in trials)
    counts = ", ".join(f"{count} {state}" for state, count in states.items())
    say(
        console,
        f"{len(trials)} trials: {counts}; {n_runs} of {len(trials) * len(tuning.seeds)} runs, "
        f"{duration(seconds)} of processor time",
    )


_STATES = {"COMPLETE": "judged to the end", "PRUNED": "ended early", "FAIL": "failed"}


def print_outcome(console: Console, place: OpenTuning, outcome: Outcome) -> None:
    """Print what the re-test shows: a table, and what follows from it."""
    tuning = place.tuning
    held_out = tuning.held_out
    console.print()
    table = Table(
        box=None,
        pad_edge=False,
        title=f"re-test on the seeds {held_out.start} to {held_out.stop - 1}",
        title_justify="left",
    )
    for heading in (
        "settings",
        "in the search",
        "on other seeds",
        "95 % interval",
        "is",
        "runs",
        "failed",
    ):
        table.add_column(heading)
    for each in outcome.retested:
        table.add_row(*_cells(each))
    console.print(table, highlight=False)
    if outcome.optimism is not None:
        say(
            console,
            "optimism of the search, its best there less the same on other seeds: "
            f"{round(outcome.optimism, 9):+.4g}",
        )
    if outcome.winner is None:
        say(console, f"no winner: {outcome.reason}; they stay as they are")


def _cells(each: Retested) -> list[str]:
    interval = each.interval
    ends = "" if math.isnan(interval.low) else f"{interval.low:.4g} to {interval.high:.4g}"
    return [
        each.label,
        _figure(each.in_search),
        _figure(each.held_out),
        ends,
        each.verdict,
        str(each.n_runs),
        "" if each.n_failed is None else str(each.n_failed),
    ]


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def print_winner(console: Console, outcome: Outcome, path: Path, how: str) -> None:
    """Say which settings won, and where they are."""
    assert outcome.winner is not None
    say(console, f"winner: {outcome.winner.label}, in {path}: {how}")


def print_entry(console: Console, entry: Mapping[str, Any], shipped: Mapping[str, Any]) -> None:
    """Print what settings differ in from those that the search began with."""
    for key in _differing(entry, shipped):
        say(console, f"  {key}: {entry.get(key, 'left out')} (was {shipped.get(key, 'left out')})")


def _differing(entry: Mapping[str, Any], shipped: Mapping[str, Any]) -> Sequence[str]:
    return [key for key in {**shipped, **entry} if entry.get(key) != shipped.get(key)]
