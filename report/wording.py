"""Figures as a reader wants them, and words in a row."""

from __future__ import annotations

import math
from collections.abc import Sequence

from verdicts import Estimate

SIGNIFICANT = 4  # digits

_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth")


def number(value: float | None) -> str:
    """A figure with four significant digits, or a dash where there is none."""
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never" if value > 0 else "-∞"
    if value == 0 or abs(value) >= 10 ** (SIGNIFICANT - 1):
        return f"{value:,.0f}"
    digits = SIGNIFICANT - 1 - math.floor(math.log10(abs(value)))
    text = f"{value:.{min(max(digits, 0), SIGNIFICANT)}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def interval(estimate: Estimate) -> str:
    """A figure with its interval in brackets, where it has one."""
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return number(estimate.point)
    return f"{number(estimate.point)} [{number(estimate.low)}, {number(estimate.high)}]"


def interval_alone(estimate: Estimate) -> str:
    """The interval of a figure, empty where it has none."""
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return ""
    return f"{number(estimate.low)} to {number(estimate.high)}"


def optimum_words(optimum: float | None, at_least: float | None) -> str:
    """The optimum; where it is bracketed, its ends with as many digits as tell them apart."""
    if at_least is None or optimum is None:
        return number(optimum)
    ends = [number(at_least), number(optimum)]
    if ends[0] == ends[1]:
        ends = [f"{at_least:,.3f}", f"{optimum:,.3f}"]
    return f"{ends[0]} to {ends[1]} (bracketed)"


def enumeration(words: Sequence[str]) -> str:
    """Words joined by commas, the last by "and"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 2 else words)


def seeds(*counts: int) -> str:
    """So many seeds, or from so many to so many."""
    least, most = min(counts), max(counts)
    return f"{'' if least == most else f'{least:,} to '}{most:,} seed{'s' if most != 1 else ''}"


def ordinal(n: int) -> str:
    """Which of several, in a word where there is a short one."""
    if n <= len(_ORDINALS):
        return _ORDINALS[n - 1]
    ending = "th" if 10 < n % 100 < 20 else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n:,}{ending}"
