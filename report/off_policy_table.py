"""``compare.py --logged``: policies on a log as a table, and what it says in words."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from experiments.off_policy.estimators import difference_in_value, mean_reward
from experiments.off_policy.logged_policies import (
    Comparison,
    Judged,
)
from verdicts import Estimate

# Where an estimate rests on fewer pulls, its interval is hardly one.
FEW_PULLS = 100
SHORT, MOST_DECIMALS = 3, 6


def print_comparison(console: Console, comparison: Comparison) -> None:
    """Print the table, what it says in sentences, and the notes."""
    console.print(_table(comparison))
    for sentence in [*sentences(comparison), *comparison.notes]:
        console.print(f"  {sentence}")


def _table(comparison: Comparison) -> Table:
    data = comparison.data
    table = Table(
        title=f"{data.source}: {len(data):,} pulls, {data.n_arms} arms",
        caption="mean reward a pull, ± half the 95 % interval; effective: pulls of its own that "
        "the log is worth; differences below: 95 % intervals that hold together",
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
    """Doubly robust: each policy asked about against the best alternative, and among themselves.

    Which alternative and which policy is best the same log has said. So the intervals are such as
    hold together for all pairs that could have been picked.
    """
    given = [row for row in comparison.rows if row.is_given]
    alternatives = [row for row in comparison.rows if not row.is_given]
    alternative, leader = max(alternatives, key=_value), max(given, key=_value)
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
    """As many as give half the interval two significant digits."""
    half = (estimate.high - estimate.low) / 2
    if not half > 0:
        return SHORT
    return min(max(1 - math.floor(math.log10(half)), 0), MOST_DECIMALS)


def _value(row: Judged) -> float:
    return float(row.terms.doubly_robust.mean())
