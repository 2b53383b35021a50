"""A study in the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.off_policy.estimators import difference_in_value, mean_reward
from experiments.plan import tuning_seeds
from experiments.study import METRIC_WORDS, StudySpec
from report.conclusions import (
    conclusion,
    overall_sentences,
    pairs_both_ways,
    seeds_of,
    unseen_sentence,
)
from report.ranking import BANDIT_COLUMNS, COLUMNS, Cell, Column, Row, filled
from report.words import enumeration, number, optimum_words, seed_sentence
from verdicts import FEW, Estimate

if TYPE_CHECKING:  # a study loads no PyTorch in the process that reads it
    from experiments.off_policy.logged_policies import Comparison, Judged

# A study in the terminal.

MOST_AGENT_WIDTH = 20
UNBOUNDED = 10_000  # columns
# Columns to drop, in this order, while a table is wider than the terminal; the page has all.
FIRST_LEFT_OUT = (
    *("training", "median", "stays from", "simple regret", "reward"),
    *("CPU time", "score", "best arm"),
)


def print_analysis(console: Console, analysis: StudyAnalysis) -> None:
    """Print a table and a conclusion for each environment, then a sentence on the seeds."""
    for sentence in overall_sentences(analysis):
        console.print()
        console.print(sentence, highlight=False)
    for environment in analysis.environments:
        console.print()
        _print_ranking(console, analysis, environment)
        _print_conclusion(console, analysis.study, environment)
    console.print()
    if unseen := unseen_sentence(analysis):
        console.print(unseen, highlight=False)
    origin = seed_sentence(analysis.study.seeds, tuning_seeds(analysis.study))
    console.print(origin, highlight=False)


def _print_conclusion(console: Console, study: StudySpec, environment: EnvironmentAnalysis) -> None:
    """Print the lead, the pairs (as a table of words for three agents or more), and the notes."""
    said = conclusion(study, environment)
    told: list[str | Table] = [said.lead]
    table = _words_of_pairs(environment)
    fits = len(environment.agents) > 2 and _width(console, table) <= console.width
    told += [table] if fits else said.pairs
    for each in (*told, *said.notes):
        console.print(each, highlight=False)


def _words_of_pairs(environment: EnvironmentAnalysis) -> Table:
    """The word on the agent of each row, against the agents below it in the ranking."""
    names = [agent.agent for agent in environment.agents]
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("", overflow="fold", max_width=MOST_AGENT_WIDTH)
    for name in names[1:]:
        table.add_column(f"vs {name}", overflow="fold", max_width=MOST_AGENT_WIDTH)
    pairs = pairs_both_ways(environment.pairs)
    for place, name in enumerate(names[:-1], start=1):
        words = [
            pairs[name, other].text if (name, other) in pairs else "" for other in names[place:]
        ]
        table.add_row(name, *[""] * (place - 1), *words)
    return table


def _print_ranking(
    console: Console, analysis: StudyAnalysis, environment: EnvironmentAnalysis
) -> None:
    pulls, label = analysis.results.pulls, environment.environment
    rows = [
        Row(agent, environment, pulls.get((agent.agent, label))) for agent in environment.agents
    ]
    on_bandit = [row for row in rows if row.pulls is not None]
    if on_bandit:
        left_out = _print_fitting(console, label, BANDIT_COLUMNS, on_bandit)
        explained = _bandit_caption(analysis.study, left_out)
    else:
        columns = [column for column in COLUMNS if column.terminal]
        title = label
        if environment.optimum is not None:
            ends = environment.optimum, environment.optimum_at_least
            title += f": optimum {optimum_words(*ends, environment.optimum_is_proven)}"
            title += f", best random or constant policy {number(environment.baseline)}"
        left_out = _print_fitting(console, title, columns, rows)
        explained = _caption(analysis.study, environment, left_out)
    if left_out:
        explained.append(f"a wider terminal shows {enumeration(left_out)} too")
    # As wide as the terminal, and not as the table, which may be narrow.
    console.print("; ".join(explained), style="italic dim", highlight=False)


def _print_fitting(
    console: Console, title: str, columns: Sequence[Column], rows: Sequence[Row]
) -> list[str]:
    """Print a table with the columns that fit; return the headings of the others."""
    shown = filled(columns, rows)
    left_out: list[str] = []
    there = [column.terminal for column, _ in shown]
    to_leave_out = [heading for heading in FIRST_LEFT_OUT if heading in there]
    while _width(console, table := _table(title, shown, rows)) > console.width and to_leave_out:
        left_out.append(to_leave_out.pop(0))
        shown = [(column, cells) for column, cells in shown if column.terminal != left_out[-1]]
    console.print(table)
    return left_out


def _table(title: str, shown: Sequence[tuple[Column, list[Cell]]], rows: Sequence[Row]) -> Table:
    table = Table(title=title, title_justify="left")
    names = [row.agent.marked for row in rows]
    # Longer names wrap.
    width = min(max(map(len, names)), MOST_AGENT_WIDTH)
    table.add_column("agent", overflow="fold", min_width=width, max_width=MOST_AGENT_WIDTH)
    for column, _ in shown:
        table.add_column(column.terminal, justify="right")
    for place, name in enumerate(names):
        cells = [cells[place] for _, cells in shown]
        table.add_row(name, *(cell.in_line or cell.text for cell in cells))
    return table


def _caption(
    study: StudySpec, environment: EnvironmentAnalysis, left_out: Sequence[str]
) -> list[str]:
    rows = [Row(agent, environment) for agent in environment.agents]
    on_variant = any(agent.on_variant for agent in environment.agents)
    words = {
        "threshold": number(environment.threshold),
        "failed": number(environment.failure_threshold),
        "variants": " (*: on a variant of the environment)" if on_variant else "",
    }
    n_runs = [agent.n_runs for agent in environment.agents]
    what = "the range of the runs" if max(n_runs, default=0) < FEW else "95 % intervals"
    told = [f"mean: {METRIC_WORDS[study.metric]} over {seeds_of(study, environment)}, with {what}"]
    if any(agent.metric.mean.low == agent.metric.mean.high for agent in environment.agents):
        told[0] += " (none where all runs are equal)"
    for column, _ in filled(COLUMNS, rows):
        if column.terminal and column.caption and column.terminal not in left_out:
            told.append(f"{column.terminal}: {column.caption.format(**words)}")
    return told


def _bandit_caption(study: StudySpec, left_out: Sequence[str]) -> list[str]:
    explained = [
        f"regret: sum over the pulls of a run, with 95 % intervals over {study.n_seeds} runs"
    ]
    if "simple regret" not in left_out:
        explained.append("simple regret: of recommending the arm pulled most")
    last = [name for name in ("reward", "best arm") if name not in left_out]
    return [*explained, f"{', '.join(last)}: at the last pulls"] if last else explained


def print_episodes_table(console: Console, table: pd.DataFrame, width: int) -> None:
    """Print the table of `episodes_table`, with as many agents side by side as fit."""
    for environment, rows in table.groupby("environment", sort=False):
        title = f"{environment}: return per {width} episodes (average, min, max; all seeds)"
        left = list(dict.fromkeys(rows["agent"]))
        while left:
            for n in range(len(left), 0, -1):
                printed = _episodes(title, rows, left[:n])
                if _width(console, printed) <= console.width:
                    break
            console.print()
            console.print(printed)
            left = left[n:]


def _episodes(title: str, rows: pd.DataFrame, agents: Sequence[str]) -> Table:
    printed = Table(title=title, title_justify="left")
    printed.add_column("episode", justify="right")
    for agent in agents:
        printed.add_column(str(agent), justify="right", overflow="fold")
    cells = {
        (row["episode"], row["agent"]): "  ".join(
            number(row[name]) for name in ("average", "minimum", "maximum")
        )
        for _, row in rows.iterrows()
    }
    for episode in sorted(set(rows["episode"])):
        printed.add_row(f"{episode:,}", *(cells.get((episode, agent), "-") for agent in agents))
    return printed


def _width(console: Console, table: Table) -> int:
    return Measurement.get(console, console.options.update(width=UNBOUNDED), table).maximum


# ``compare.py --logged``: policies on a log as a table and in sentences.

# With a smaller effective sample size, the interval of an estimate is unreliable.
FEW_PULLS = 100
SHORT, MOST_DECIMALS = 3, 6


def print_comparison(console: Console, comparison: Comparison) -> None:
    """Print the table, sentences on it, and the notes."""
    console.print(_off_policy_table(comparison))
    for sentence in [*sentences(comparison), *comparison.notes]:
        console.print(f"  {sentence}")


def _off_policy_table(comparison: Comparison) -> Table:
    data = comparison.data
    table = Table(
        title=f"{data.source}: {len(data):,} pulls, {data.n_arms} arms",
        caption="mean reward a pull, ± half the 95 % interval; effective: effective sample size "
        "in pulls; differences below: simultaneous 95 % intervals",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("policy", overflow="fold", min_width=12)
    for heading in ("IPS", "self-normalised", "direct", "doubly robust", "effective"):
        table.add_column(heading, justify="right")
    for row in comparison.rows:
        terms = row.terms
        columns = (terms.ips, terms.snips, terms.direct, terms.doubly_robust)
        cells = [shown(mean_reward(column)) for column in columns]
        table.add_row(row.name, *cells, f"{terms.effective:,.0f}")
    return table


def sentences(comparison: Comparison) -> list[str]:
    """Doubly robust: each given policy against the best alternative and the best given policy.

    The best are chosen on the same log. So the intervals are simultaneous over all pairs that could
    have been chosen.
    """
    given = [row for row in comparison.rows if row.is_given]
    alternatives = [row for row in comparison.rows if not row.is_given]
    alternative, leader = (
        max(rows, key=lambda row: row.terms.doubly_robust.mean()) for rows in (alternatives, given)
    )
    n_pairs = len(given) * len(alternatives) + math.comb(len(given), 2)
    pairs = [(row, alternative) for row in given]
    pairs += [(leader, row) for row in given if row is not leader]
    result = [_difference(*pair, n_pairs) for pair in pairs]
    result += [
        f"{row.name} rests on {row.terms.effective:.0f} effective pulls: too few to rely on its "
        "intervals"
        for row in given
        if row.terms.effective < FEW_PULLS
    ]
    return result


def _difference(first: Judged, second: Judged, n_pairs: int) -> str:
    difference = difference_in_value(first.terms, second.terms, n_pairs)
    if difference.low == difference.high == 0:
        return f"{first.name} and {second.name} do the same on this log"
    decimals = _decimals(difference)
    point, low, high = (
        f"{value:+.{decimals}f}" for value in (difference.point, difference.low, difference.high)
    )
    return (
        f"{first.name} against {second.name}: {point} [{low}, {high}] a pull, {verdict(difference)}"
    )


def verdict(difference: Estimate) -> str:
    """What the interval of a difference says."""
    if difference.low > 0:
        return "better"
    return "worse" if difference.high < 0 else "undecided"


def shown(estimate: Estimate) -> str:
    """A figure and half its interval, which is symmetric."""
    decimals = _decimals(estimate)
    half = (estimate.high - estimate.low) / 2
    return f"{estimate.point:.{decimals}f} ± {half:.{decimals}f}"


def _decimals(estimate: Estimate) -> int:
    """The number of decimals that gives half the interval two significant digits."""
    half = (estimate.high - estimate.low) / 2
    if not half > 0:
        return SHORT
    return min(max(1 - math.floor(math.log10(half)), 0), MOST_DECIMALS)
