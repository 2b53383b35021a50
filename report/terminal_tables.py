"""A study in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import pandas as pd
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.plan import tuning_seeds
from experiments.study import METRIC_WORDS, StudySpec
from report.conclusions import conclusion
from report.pair_sentences import seeds_of
from report.ranking_cells import Cell
from report.ranking_columns import BANDIT_COLUMNS, COLUMNS, BanditRow, Column, Row, filled
from report.seed_sentence import seed_sentence
from report.verdict_matrix import LEGEND, SIGNS, says_more, verdict_matrix
from report.wording import enumeration, number, optimum_words

MOST_AGENT_WIDTH = 20
UNBOUNDED = 10_000  # columns

AnyRow = TypeVar("AnyRow", bound=Row)


# Where a table is wider than the terminal it goes without these, in this order; the page has all.
FIRST_LEFT_OUT = (
    *("training", "IQM", "solved", "stays from"),
    *("simple regret", "reward", "CPU time", "score", "best arm"),
)


def print_analysis(console: Console, analysis: StudyAnalysis) -> None:
    """Print a table for each environment and what it says in words, then what seeds these are."""
    for environment in analysis.environments:
        console.print()
        _print_ranking(console, analysis, environment)
        _print_conclusion(console, analysis.study, environment)
    console.print()
    origin = seed_sentence(analysis.study.seeds, tuning_seeds(analysis.study))
    console.print(origin, highlight=False)


def _print_conclusion(console: Console, study: StudySpec, environment: EnvironmentAnalysis) -> None:
    """The verdict in a line, the pairs as a matrix where they are many, and what else there is."""
    said = conclusion(study, environment)

    def say(text: str) -> None:
        console.print(text, highlight=False)

    say(said.lead)
    if says_more(environment):
        console.print(_matrix(environment))
        say(LEGEND)
        if said.failed:
            say(said.failed)
    elif len(environment.agents) == 2:
        for sentence in said.pairs:
            say(sentence)
    for sentence in said.notes:
        say(sentence)


def _matrix(environment: EnvironmentAnalysis) -> Table:
    names = [agent.agent for agent in environment.agents]
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("")
    table.add_column("", overflow="fold", max_width=MOST_AGENT_WIDTH)
    numbers = [str(place) for place in range(1, len(names) + 1)]
    for place in numbers:
        table.add_column(place, justify="right", no_wrap=True)
    for place, name, row in zip(numbers, names, verdict_matrix(environment), strict=True):
        signs = ["·" if verdict is None else SIGNS[verdict] for verdict in row]
        table.add_row(place, name, *signs)
    return table


def _print_ranking(
    console: Console, analysis: StudyAnalysis, environment: EnvironmentAnalysis
) -> None:
    pulls, label = analysis.results.pulls, environment.environment
    on_bandit = [
        BanditRow(agent, environment, pulls[agent.agent, label])
        for agent in environment.agents
        if (agent.agent, label) in pulls
    ]
    if on_bandit:
        left_out = _print_fitting(console, label, BANDIT_COLUMNS, on_bandit)
        explained = _bandit_caption(analysis.study, left_out)
    else:
        rows = [Row(agent, environment) for agent in environment.agents]
        columns = [column for column in COLUMNS if column.terminal]
        left_out = _print_fitting(console, _title(environment), columns, rows)
        explained = _caption(analysis.study, environment, left_out)
    if left_out:
        explained.append(f"a wider terminal shows {enumeration(left_out)} too")
    # As wide as the terminal, and not as the table, which may be narrow.
    console.print("; ".join(explained), style="italic dim", highlight=False)


def _print_fitting(
    console: Console, title: str, columns: Sequence[Column[AnyRow]], rows: Sequence[AnyRow]
) -> list[str]:
    """Print a table with as many columns as there is room for; the headings of the others."""
    shown = filled(columns, rows)
    left_out: list[str] = []
    table = _table(title, shown, rows)
    for heading in FIRST_LEFT_OUT:
        if _width(console, table) <= console.width:
            break
        if heading in [column.terminal for column, _ in shown]:
            shown = [(column, cells) for column, cells in shown if column.terminal != heading]
            left_out.append(heading)
            table = _table(title, shown, rows)
    console.print(table)
    return left_out


def _table(
    title: str, shown: Sequence[tuple[Column[AnyRow], list[Cell]]], rows: Sequence[AnyRow]
) -> Table:
    table = Table(title=title, title_justify="left")
    names = [row.agent.marked for row in rows]
    # Longer names go over several lines.
    width = min(max(map(len, names)), MOST_AGENT_WIDTH)
    table.add_column("agent", overflow="fold", min_width=width, max_width=MOST_AGENT_WIDTH)
    for column, _ in shown:
        table.add_column(column.terminal, justify="right")
    for place, name in enumerate(names):
        cells = [cells[place] for _, cells in shown]
        table.add_row(name, *(cell.in_line or cell.text for cell in cells))
    return table


def _title(environment: EnvironmentAnalysis) -> str:
    title = environment.environment
    if environment.optimum is not None:
        title += f": optimum {optimum_words(environment.optimum, environment.optimum_at_least)}"
        title += f", best random or constant policy {number(environment.baseline)}"
    return title


def _caption(
    study: StudySpec, environment: EnvironmentAnalysis, left_out: Sequence[str]
) -> list[str]:
    n_seeds = seeds_of(study, environment)
    metric = f"{METRIC_WORDS[study.metric]}, with 95 % intervals over {n_seeds}"
    rows = [Row(agent, environment) for agent in environment.agents]
    explained = [
        column
        for column in COLUMNS
        if column.terminal and column.caption and column.terminal not in left_out
    ]
    on_variant = any(agent.on_variant for agent in environment.agents)
    words = {
        "threshold": number(environment.threshold),
        "variants": " (*: on a variant of the environment)" if on_variant else "",
    }
    means = ", ".join(name for name in ("mean", "IQM") if name not in left_out)
    return [
        f"{means}: {metric}",
        *(
            f"{column.terminal}: {column.caption.format(**words)}"
            for column, _ in filled(explained, rows)
        ),
    ]


def _bandit_caption(study: StudySpec, left_out: Sequence[str]) -> list[str]:
    explained = [
        f"regret: sum over the pulls of a run, with 95 % intervals over {study.n_seeds} runs"
    ]
    if "simple regret" not in left_out:
        explained.append("simple regret: of recommending the arm pulled most")
    last = [name for name in ("reward", "best arm") if name not in left_out]
    return [*explained, f"{', '.join(last)}: at the last pulls"] if last else explained


def print_episodes_table(console: Console, table: pd.DataFrame, width: int) -> None:
    """Print the table of `episodes_table`, agents side by side, as many as there is room for."""
    for environment, rows in table.groupby("environment", sort=False):
        title = f"{environment}: return per {width} episodes (average, min, max; all seeds)"
        left = list(dict.fromkeys(rows["agent"]))
        while left:
            shown = len(left)
            while shown > 1 and _width(console, _episodes(title, rows, left[:shown])) > (
                console.width
            ):
                shown -= 1
            console.print()
            console.print(_episodes(title, rows, left[:shown]))
            left = left[shown:]


def _episodes(title: str, rows: pd.DataFrame, agents: Sequence[str]) -> Table:
    printed = Table(title=title, title_justify="left")
    printed.add_column("episode", justify="right")
    for agent in agents:
        printed.add_column(str(agent), justify="right", overflow="fold")
    by_episode = rows.set_index(["episode", "agent"])
    for episode in sorted(set(rows["episode"])):
        cells = []
        for agent in agents:
            if (episode, agent) not in by_episode.index:
                cells.append("-")
                continue
            row = by_episode.loc[(episode, agent)]
            cells.append("  ".join(number(row[c]) for c in ("average", "minimum", "maximum")))
        printed.add_row(f"{episode:,}", *cells)
    return printed


def _width(console: Console, table: Table) -> int:
    return Measurement.get(console, console.options.update(width=UNBOUNDED), table).maximum
