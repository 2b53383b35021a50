"""A study in the terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import partial

import pandas as pd
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from rl_yardstick.experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from rl_yardstick.experiments.off_policy import Comparison, difference_in_value, mean_reward
from rl_yardstick.experiments.plan import tuning_seeds
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.report import ranking, words
from rl_yardstick.verdicts import FEW, Estimate

MOST_AGENT_WIDTH, LEAST_AGENT_WIDTH = 20, 12
UNBOUNDED = 10_000  # columns
# Columns to drop, in this order, while a table is wider than the terminal, and then all but the
# first, from the right; the page has all.
FIRST_LEFT_OUT = (
    *("training", "median", "stays from", "simple regret", "reward"),
    *("CPU time", "score", "best arm"),
)


def print_analysis(console: Console, analysis: StudyAnalysis) -> None:
    """Print the answer, a table and a conclusion for each environment, and a sentence on the seeds.

    The pairs are a table of words for three agents or more, if it fits, and else sentences.
    """
    console.print()
    for sentence in words.answer(analysis):
        console.print(sentence, highlight=False)
    for environment in analysis.environments:
        console.print()
        _print_ranking(console, analysis, environment)
        said, pairs = words.conclusion(analysis.study, environment), _table_of_pairs(environment)
        as_table = len(environment.agents) > 2 and _width(console, pairs) <= console.width
        for each in (said.lead, *((pairs,) if as_table else said.pairs), *said.notes):
            console.print(each, highlight=False)
    console.print()
    if unseen := words.unseen_sentence(analysis):
        console.print(unseen, highlight=False)
    origin = words.seed_sentence(analysis.study.seeds, tuning_seeds(analysis.study))
    console.print(origin, highlight=False)


def _table_of_pairs(environment: EnvironmentAnalysis) -> Table:
    """The word on the agent of each row, against the agents below it in the ranking."""
    names = [agent.agent for agent in environment.agents]
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("", overflow="fold", max_width=MOST_AGENT_WIDTH)
    for name in names[1:]:
        table.add_column(f"vs {name}", overflow="fold", max_width=MOST_AGENT_WIDTH)
    pairs = words.pairs_both_ways(environment.pairs)
    for place, name in enumerate(names[:-1], start=1):
        found = [pairs.get((name, other)) for other in names[place:]]
        cells = ["" if pair is None else pair.text for pair in found]
        table.add_row(name, *[""] * (place - 1), *cells)
    return table


def _print_ranking(console: Console, analysis: StudyAnalysis, one: EnvironmentAnalysis) -> None:
    pulls, label = analysis.results.pulls, one.environment
    agents = one.agents
    rows = [ranking.Row(agent, one, pulls.get((agent.agent, label))) for agent in agents]
    on_bandit = [row for row in rows if row.pulls is not None]
    if on_bandit:
        left_out = _print_fitting(console, label, ranking.BANDIT_COLUMNS, on_bandit)
        runs = f"over {analysis.study.n_seeds} runs"
        explained = [f"regret: sum over the pulls of a run, with 95 % intervals {runs}"]
        if "simple regret" not in left_out:
            explained.append("simple regret: of recommending the arm pulled most")
        if last := [name for name in ("reward", "best arm") if name not in left_out]:
            explained.append(f"{', '.join(last)}: at the last pulls")
    else:
        title = label
        if one.optimum is not None:
            title += f": optimum {words.optimum_words(one)}"
            title += f", best random or constant policy {words.number(one.baseline)}"
        columns = [column for column in ranking.COLUMNS if column.terminal]
        left_out = _print_fitting(console, title, columns, rows)
        explained = _caption(analysis.study, one, left_out)
    if left_out:
        explained.append(f"a wider terminal shows {words.enumeration(left_out)} too")
    # As wide as the terminal, and not as the table, which may be narrow.
    console.print("; ".join(explained), style="italic dim", highlight=False)


def _print_fitting(
    console: Console, title: str, columns: Sequence[ranking.Column], rows: Sequence[ranking.Row]
) -> list[str]:
    """Print a table with the columns that fit; return the headings of the others."""
    cells = {"agent": [row.agent.marked for row in rows]}
    for column, found in ranking.filled(columns, rows):
        cells[column.terminal] = _with_equal_decimals(found)
    order = (*FIRST_LEFT_OUT, *(column.terminal for column in columns[:0:-1]))
    table, left_out = _fitting(console, cells, order, MOST_AGENT_WIDTH)
    table.title = title
    console.print(table, crop=False)
    return left_out


_FIGURE = re.compile(r"-?[\d,]*(?:\.(\d+))?")


def _with_equal_decimals(cells: Sequence[ranking.Cell]) -> list[str]:
    """The texts of a column, in which all figures have as many decimals as the longest."""
    texts = [cell.in_line or cell.text for cell in cells]
    found = [_FIGURE.match(text) for text in texts]
    decimals = max(len(one[1] or "") for one in found if one)
    fixed = partial(words.number, decimals=decimals)
    for place, (cell, one) in enumerate(zip(cells, found, strict=True)):
        if one and one[0] == words.number(cell.value):
            was, now = one[0], fixed(cell.value)
            if cell.estimate and words.interval(cell.estimate) in texts[place]:
                was, now = words.interval(cell.estimate), words.interval(cell.estimate, fixed)
            texts[place] = texts[place].replace(was, now, 1)
        elif one and one[0] == texts[place] and decimals:  # a score, which is rounded down
            texts[place] = f"{one[0].partition('.')[0]}.{one[1] or '':0<{decimals}}"
    return texts


def _aligned(texts: Sequence[str]) -> list[str]:
    """The texts with their first figures one below the other, aligned at the decimal point."""
    whole = [text.partition(" ")[0].partition(".")[0].rstrip("%") for text in texts]
    most = max(map(len, whole))
    return [" " * (most - len(one)) + text for one, text in zip(whole, texts, strict=True)]


def _fitting(
    console: Console, cells: dict[str, list[str]], order: Sequence[str], most: int = UNBOUNDED
) -> tuple[Table, list[str]]:
    """A table with the columns that fit, and the headings of the others, left out in this order.

    Numbers never wrap. Names, in the first column, wrap at ``most``, and earlier where all columns
    that may be left out are. A table that still does not fit runs beyond the edge of the terminal.
    """
    heading, *others = cells
    cells = cells | {each: _aligned(cells[each]) for each in others}
    longest = max(map(len, [heading, *cells[heading]]))
    left_out: list[str] = []
    to_leave_out = list(dict.fromkeys(each for each in order if each in cells))

    def table(width: int) -> Table:
        kept = {each: column for each, column in cells.items() if each not in left_out}
        made = Table(title_justify="left")
        made.add_column(heading, no_wrap=True, width=width)
        for each in list(kept)[1:]:
            made.add_column(each, no_wrap=True)
        for name, *row in zip(*kept.values(), strict=True):
            made.add_row(folded(name, width), *row)
        return made

    while True:
        room = console.width - _width(console, table(LEAST_AGENT_WIDTH)) + LEAST_AGENT_WIDTH
        if not to_leave_out or min(longest, MOST_AGENT_WIDTH) <= room:
            break
        left_out.append(to_leave_out.pop(0))
    result = table(min(longest, most, max(room, LEAST_AGENT_WIDTH)))
    needed = _width(console, result)
    result.width = needed if needed > console.width else None
    return result, left_out


def folded(name: str, width: int, ends: Sequence[str] = (r"[\s/,]", "[_=-]")) -> str:
    """A name in lines of at most ``width`` letters, which end at the first ``ends`` if possible."""
    if len(name) <= width or not ends:
        return "\n".join(name[k : k + width] for k in range(0, len(name), width))
    lines = [""]
    for word in re.split(f"(?<={ends[0]})", name):
        if lines[-1] and len(lines[-1] + word.rstrip()) > width:
            lines.append("")
        lines[-1] += word
    return "\n".join(folded(line.rstrip(), width, ends[1:]) for line in lines)


def _caption(study: StudySpec, one: EnvironmentAnalysis, left_out: Sequence[str]) -> list[str]:
    rows = [ranking.Row(agent, one) for agent in one.agents]
    on_variant = any(agent.changes for agent in one.agents)
    figures = {
        "threshold": words.number(one.threshold),
        "failed": words.number(one.failure_threshold),
        "variants": " (*: on a variant of the environment)" if on_variant else "",
    }
    over = words.seeds(*(one.seeds.values() or [study.n_seeds]))
    n_runs = [agent.n_runs for agent in one.agents]
    what = "the range of the runs" if max(n_runs, default=0) < FEW else "95 % intervals"
    told = [f"mean: {study.metric_words} over {over}, with {what}"]
    if any(agent.metric.mean.low == agent.metric.mean.high for agent in one.agents):
        told[0] += " (none where all runs are equal)"
    shown = [column.terminal for column, _ in ranking.filled(ranking.COLUMNS, rows)]
    known = [name for name in shown if name in ranking.CAPTIONS and name not in left_out]
    return told + [f"{name}: {ranking.CAPTIONS[name].format(**figures)}" for name in known]


def print_episodes_table(console: Console, table: pd.DataFrame, width: int) -> None:
    """Print the table of `episodes_table`, one for each agent on each environment."""
    for (environment, agent), rows in table.groupby(["environment", "agent"], sort=False):
        cells = {"episode": [f"{episode:,}" for episode in rows["episode"]]}
        for heading in ("average", "minimum", "maximum"):
            cells[heading] = _with_equal_decimals([*map(ranking.number_cell, rows[heading])])
        printed, _ = _fitting(console, cells, ())
        printed.title = f"{agent} on {environment}: return per {width} episodes, all seeds"
        console.print()
        console.print(printed, crop=False)


def _width(console: Console, table: Table) -> int:
    return Measurement.get(console, console.options.update(width=UNBOUNDED), table).maximum


# With a smaller effective sample size, the interval of an estimate is unreliable.
FEW_PULLS = 100
SHORT, MOST_DECIMALS = 3, 6
# The estimates of a policy, by heading.
ESTIMATES = {"IPS": "ips", "self-normalised": "snips", "doubly robust": "doubly_robust"}
# Columns to drop, in this order, while the table is wider than the terminal.
OFF_POLICY_LEFT_OUT = ("IPS", "self-normalised", "effective")


def print_comparison(console: Console, comparison: Comparison) -> None:
    """Print the table, sentences on it, and the notes."""
    data = comparison.data
    title = f"{data.source}: {len(data):,} pulls, {data.n_arms} arms"
    console.print(title, style="italic", highlight=False)
    cells = {"policy": [row.name for row in comparison.rows]}
    for heading, kind in ESTIMATES.items():
        cells[heading] = [shown(mean_reward(getattr(row.terms, kind))) for row in comparison.rows]
    cells["effective"] = [f"{row.terms.effective:,.0f}" for row in comparison.rows]
    table, left_out = _fitting(console, cells, OFF_POLICY_LEFT_OUT)
    console.print(table, crop=False)
    explained = (
        "mean reward a pull, ± half the 95 % interval; effective: effective sample size in pulls; "
        "differences below: simultaneous 95 % intervals"
    )
    explained += f"; a wider terminal shows {words.enumeration(left_out)} too" if left_out else ""
    console.print(explained, style="italic dim", highlight=False)
    for sentence in [*sentences(comparison), *comparison.notes]:
        console.print(f"  {sentence}")


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
    result = []
    for one, other in pairs:
        difference = difference_in_value(one.terms, other.terms, n_pairs)
        if difference.low == difference.high == 0:
            result.append(f"{one.name} and {other.name} do the same on this log")
            continue
        form = f"+.{_decimals(difference)}f"
        word = "better" if difference.low > 0 else "worse" if difference.high < 0 else "undecided"
        result.append(
            f"{one.name} against {other.name}: {difference.point:{form}} "
            f"[{difference.low:{form}}, {difference.high:{form}}] a pull, {word}"
        )
    result += [
        f"{row.name} rests on {row.terms.effective:.0f} effective pulls: too few to rely on its "
        "intervals"
        for row in given
        if row.terms.effective < FEW_PULLS
    ]
    return result


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
