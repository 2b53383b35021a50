"""The columns of the ranking, for the terminal and for the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rl_yardstick.experiments.analysis import AgentAnalysis, EnvironmentAnalysis
from rl_yardstick.experiments.bandits import QUANTILES, PullStatistics
from rl_yardstick.report.words import Format, interval, interval_alone, number, score_number
from rl_yardstick.verdicts import Estimate, ThresholdSummary


@dataclass(frozen=True)
class Cell:
    """One cell."""

    text: str  # the figure
    value: float | None  # the sort key; None sorts last
    note: str = ""  # small print below it on the page
    in_line: str = ""  # the terminal's text, if it differs
    aside: str = ""  # its tooltip on the page
    # Low end, point and high end of a bar to draw, each between 0 and 1; or None.
    bar: tuple[float, ...] | None = None
    estimate: Estimate | None = None  # the figure with its interval, if it has one


def bar(score: Estimate) -> tuple[float, ...]:
    """Low end, point and high end of a score, clipped to [0, 1]."""
    ends = score.low, score.point, score.high
    return tuple(0.0 if math.isnan(end) else round(min(max(end, 0.0), 1.0), 4) for end in ends)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def estimate_cell(estimate: Estimate, as_text: Format = number) -> Cell:
    """A figure with its interval, or with the range of few runs."""
    note, in_line = interval_alone(estimate, as_text), interval(estimate, as_text)
    point = estimate.point
    return Cell(as_text(point), _known(point), note, in_line, estimate=estimate)


def threshold_cell(stays: ThresholdSummary | None) -> Cell | None:
    """When the median run reaches the threshold to stay, and the share of runs that do."""
    if stays is None:
        return None
    median, share = stays.median.point, stays.share_reached.point
    note = "" if math.isnan(share) else f"{share:.0%} of runs"
    return Cell(number(median), _known(median), note)


def number_cell(value: float) -> Cell:
    """A figure without an interval."""
    return Cell(number(value), _known(value))


# The columns: a new statistic is one more entry of `COLUMNS`.

Order = Literal["ascending", "descending"]


@dataclass(frozen=True)
class Row:
    """A row of the ranking: an agent on an environment."""

    agent: AgentAnalysis
    environment: EnvironmentAnalysis
    pulls: PullStatistics | None = None  # on a bandit: its figures by pull


@dataclass(frozen=True)
class Column:
    """One column, left out of the page or the terminal if its heading there is empty."""

    cell: Callable[[Row], Cell | None]  # its cell in a row; None if it does not apply
    page: str = ""  # its heading on the page
    help: str = ""  # small print below that heading; ``{threshold}`` is the environment's
    # The order that puts the best first; None for that of the study's metric.
    best_first: Order | None = None
    terminal: str = ""  # its heading in the terminal


def filled(columns: Sequence[Column], rows: Sequence[Row]) -> list[tuple[Column, list[Cell]]]:
    """The columns that apply to some row, each with a cell for every row."""
    found = [(column, [column.cell(row) for row in rows]) for column in columns]
    dash = Cell("-", None)
    return [(column, [cell or dash for cell in cells]) for column, cells in found if any(cells)]


def _score(row: Row) -> Cell | None:
    if row.agent.score is None:
        return None
    mean = row.agent.score
    cell = replace(estimate_cell(mean, score_number), in_line="")  # the mean has its interval
    return cell if math.isnan(mean.point) else replace(cell, bar=bar(mean))


def _gap(row: Row) -> Cell | None:
    optimum, final = row.environment.optimum, row.agent.final
    if optimum is None:
        return None
    at_least = row.environment.optimum_at_least
    # If the optimum is bracketed, the gap's interval covers both ends of the bracket.
    low, high = (optimum if at_least is None else at_least) - final.high, optimum - final.low
    return estimate_cell(replace(final, point=optimum - final.point, low=low, high=high))


def _success(row: Row) -> Cell | None:
    rate = row.agent.success_rate
    if rate is None:
        return None
    if math.isnan(rate.point):
        return Cell("-", None)
    note = f"{rate.low:.0%} to {rate.high:.0%}" if interval_alone(rate) else ""
    return Cell(f"{rate.point:.1%}", rate.point, note)


def _failed(row: Row) -> Cell | None:
    runs = row.agent.runs
    if runs.failed is None:
        return None
    low, high = runs.failed_interval
    return Cell(f"{runs.failed} of {runs.n}", runs.failed / runs.n, f"{low:.0%} to {high:.0%}")


def _stays_from(row: Row) -> Cell | None:
    cell, first = threshold_cell(row.agent.steps_to_stay), row.agent.steps_to_threshold
    if cell is None or first is None or math.isnan(first.median.point):
        return cell
    # A curve that has crossed the threshold may have fallen again.
    share = f"{first.share_reached.point:.0%} of runs are there at some evaluation"
    aside = f"{share}, the median run first at step {number(first.median.point)}"
    return replace(cell, aside=aside)


def _seconds(row: Row) -> Cell | None:
    seconds = row.agent.seconds
    if math.isnan(seconds.point):
        return None
    return replace(estimate_cell(seconds), in_line=f"{number(seconds.point)} s")


def _training(row: Row) -> Cell | None:
    if math.isnan(row.agent.last_episodes.point):
        return None
    cell = estimate_cell(row.agent.last_episodes)
    return replace(cell, in_line=f"{cell.in_line} *") if row.agent.changes else cell


def _runs(row: Row) -> Cell:
    missing = f"{row.agent.n_missing} missing" if row.agent.n_missing else ""
    return Cell(f"{row.agent.n_runs}", row.agent.n_runs, missing)


def _spread(pulls: PullStatistics) -> Cell:
    low, *_, high = np.quantile(pulls.total_regret, QUANTILES)
    return Cell(f"{number(low)} to {number(high)}", float(high))


def _by_pulls(cell: Callable[[PullStatistics], Cell]) -> Callable[[Row], Cell | None]:
    """A cell for bandits only."""
    return lambda row: None if row.pulls is None else cell(row.pulls)


# A new statistic is one more entry.
COLUMNS = (
    Column(lambda row: estimate_cell(row.agent.metric.mean), "Mean", "over seeds", None, "mean"),
    Column(lambda row: number_cell(row.agent.metric.iqm), "IQM", "middle half"),
    Column(
        lambda row: estimate_cell(row.agent.metric.median), "Median", "over seeds", None, "median"
    ),
    Column(_score, "Score", "1 is optimal", "descending", "score"),
    Column(_failed, "Failed", "runs below {failed}", "ascending", "failed"),
    Column(_gap, "Gap", "to the optimum", "ascending"),
    Column(_training, terminal="training"),
    Column(_success, "Success", "in the end", "descending"),
    Column(_stays_from, "Stays from", "step, at {threshold}", "ascending", "stays from"),
    Column(
        lambda row: threshold_cell(row.agent.episodes_to_stay),
        "Episodes",
        "to stay at {threshold}",
        "ascending",
    ),
    Column(_seconds, "CPU time", "seconds of training", "ascending", "CPU time"),
    Column(_runs, "Runs", "finished", "descending"),
)
# What the terminal says of columns below the table; ``{variants}`` explains the mark of agents
# that were trained on a variant of the environment.
CAPTIONS = {
    "failed": "runs with a score below {failed}, half the best median",
    "training": "return of the last 100 training episodes{variants}",
    "stays from": "median step from which the return stays above {threshold}",
}


def _other_return(returns: Estimate | None, words: str) -> Cell:
    if returns is None:
        return Cell("unknown", None)
    cell = estimate_cell(returns)
    return replace(cell, note="; ".join(filter(None, (cell.note, words))))


def _discounted(row: Row) -> Cell | None:
    discount, optimum = row.agent.discount, row.agent.discounted_optimum
    if discount is None:  # an agent that has none
        return None
    words = f"by {discount:g}" + ("" if optimum is None else f"; optimum {number(optimum)}")
    return _other_return(row.agent.discounted, words)


# On the page, folded below the ranking.
OTHER_RETURNS = (
    Column(
        lambda row: estimate_cell(row.agent.final),
        "Greedy",
        "the final policy's return",
        "descending",
    ),
    Column(
        lambda row: _other_return(row.agent.stochastic, row.agent.acts_by),
        "Stochastic",
        "as it acts in training",
        "descending",
    ),
    Column(_discounted, "Discounted", "greedy, under its own discount", "descending"),
)

# In the terminal, bandits have a table of their own; on the page, a section.
BANDIT_COLUMNS = (
    Column(lambda row: estimate_cell(row.agent.regret), terminal="mean regret"),
    Column(_by_pulls(_spread), terminal=f"{QUANTILES[0]:.0%} to {QUANTILES[-1]:.0%} of runs"),
    Column(_by_pulls(lambda p: number_cell(p.simple_regret[-1])), terminal="simple regret"),
    Column(_by_pulls(lambda p: number_cell(p.reward[-1])), terminal="reward"),
    Column(
        _by_pulls(lambda p: Cell(f"{p.optimal[-1]:.1%}", float(p.optimal[-1]))), terminal="best arm"
    ),
    Column(_seconds, terminal="CPU time"),
)
