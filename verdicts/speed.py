"""Which agent reaches a threshold sooner, from curves that were looked at now and then."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from verdicts.estimates import Estimate
from verdicts.judgement import FEWEST_SEEDS
from verdicts.paired import holm
from verdicts.rank_tests import apart_p_value
from verdicts.score_arrays import Floats
from verdicts.typical import interval_places


@dataclass(frozen=True)
class SpeedComparison:
    """How many times the steps of one agent another needs.

    Attributes:
        first, second: their names, in the order of the mapping.
        ratio: steps of the second divided by those of the first: the median over pairs of runs. The
            intervals of all pairs hold together, wherever between two evaluations runs arrived.
        adjusted_p_value: of "one of the two is sooner", after Holm's correction over all pairs.
        sooner: the name of the one that is shown to be, or None.
    """

    first: str
    second: str
    ratio: Estimate
    adjusted_p_value: float
    sooner: str | None


def compare_speed(
    steps: Mapping[str, ArrayLike], spacing: float, level: float = 0.05
) -> list[SpeedComparison]:
    """Compare every two agents, in the order of the mapping.

    Args:
        steps: by agent, shape (n_seeds,): the evaluation at which a run had arrived; infinity for a
            run that never did, NaN for one that is missing.
        spacing: the most steps between two evaluations. A run that had arrived at one may have
            arrived at any step since the one before: times that share such a span are equal.
        level: the share of studies in which anything said here may be wrong.
    """
    arrived = {
        name: np.ceil(found[~np.isnan(found)] / spacing) * spacing
        for name, found in ((name, np.asarray(each, np.float64)) for name, each in steps.items())
    }
    pairs = [
        pair
        for pair in combinations(arrived, 2)
        if min(len(arrived[name]) for name in pair) >= FEWEST_SEEDS
    ]
    p_values = holm([apart_p_value(*_ranked(arrived[a], arrived[b])) for a, b in pairs])
    found = []
    for (a, b), p_value in zip(pairs, p_values, strict=True):
        ratio = _ratio(arrived[a], arrived[b], spacing, level / len(pairs))
        sooner = None
        if p_value <= level:
            sooner = a if ratio.low > 1 else b if ratio.high < 1 else None
        found.append(SpeedComparison(a, b, ratio, float(p_value), sooner))
    return found


def _ranked(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Times as scores: the sooner the higher, never below all."""
    both = np.concatenate([first, second])
    last = both[np.isfinite(both)].max(initial=0.0) + 1
    return -np.minimum(first, last), -np.minimum(second, last)


def _ratio(first: Floats, second: Floats, spacing: float, level: float) -> Estimate:
    """The ratio of times, between those that the spans of the arrivals allow."""
    both = np.concatenate([first, second])
    # Runs that never arrived would have taken longer than any that did.
    last = both[np.isfinite(both)].max(initial=0.0)
    x, y = first[:, None], second
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = np.where(np.isinf(x) & np.isinf(y), 1.0, y / x)
        least = np.where(np.isinf(x), 0.0, (np.minimum(y, last + spacing) - spacing) / x)
        most = y / (np.minimum(x, last + spacing) - spacing)
    n = min(len(first), len(second))
    places = interval_places(len(first), len(second), level)
    low, high = np.nan, np.nan
    if places is not None:
        low = np.sort(least, axis=None)[places[0]]
        high = np.sort(np.where(np.isnan(most), np.inf, most), axis=None)[places[1]]
    return Estimate(float(np.median(middle)), float(low), float(high), n)
