"""Figures as cells of the ranking: what stands there, and what it is sorted by."""

from __future__ import annotations

import math
from dataclasses import dataclass

from report.wording import interval, interval_alone, number
from verdicts import Estimate, ThresholdSummary


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes:
        text: the figure.
        value: what it is sorted by; None puts it last.
        note: what the page has below it in small print.
        in_line: what the terminal has in place of the text, where it has something else.
        aside: what the page says where the pointer rests on it.
        bar: low end, point and high end, each between 0 and 1, of a bar to draw; or None.
    """

    text: str
    value: float | None
    note: str = ""
    in_line: str = ""
    aside: str = ""
    bar: tuple[float, float, float] | None = None


def bar(score: Estimate) -> tuple[float, float, float]:
    """Low end, point and high end of a score, cut to what lies between 0 and 1."""
    low, high = (score.low, score.high) if score.has_interval else (score.point, score.point)
    return (_share(low), _share(score.point), _share(high))


def _share(value: float) -> float:
    return 0.0 if math.isnan(value) else round(min(max(value, 0.0), 1.0), 4)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def estimate_cell(estimate: Estimate) -> Cell:
    """A figure with its interval."""
    return Cell(
        number(estimate.point),
        _known(estimate.point),
        interval_alone(estimate),
        interval(estimate),
    )


def threshold_cell(stays: ThresholdSummary | None) -> Cell | None:
    """From when on the median run stays at the threshold, and how many runs do."""
    if stays is None:
        return None
    median, share = stays.median.point, stays.share_reached.point
    note = "" if math.isnan(share) else f"{share:.0%} of runs"
    return Cell(number(median), _known(median), note)


def crossing(first: ThresholdSummary | None) -> str:
    """When a curve that may have fallen again was at the threshold for the first time."""
    if first is None or math.isnan(first.median.point):
        return ""
    share = f"{first.share_reached.point:.0%} of runs are there at some evaluation"
    return f"{share}, the median run first at step {number(first.median.point)}"


def number_cell(value: float) -> Cell:
    """A figure without an interval."""
    return Cell(number(value), _known(value))
