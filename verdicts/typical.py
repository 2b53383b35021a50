"""How far apart the typical runs of two agents are."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import stats

from verdicts.estimates import Estimate
from verdicts.paired import differences
from verdicts.rank_tests import MOST_COUNTED, rank_sum_tail
from verdicts.score_arrays import Floats


def typical_difference(first: Floats, second: Floats, level: float) -> Estimate:
    """The median of all differences between a run of ``first`` and one of ``second``.

    Its interval goes from one of these differences to another, so that it never leaves what is
    possible. It belongs to the rank-sum test: where scores differ by a shift, it holds those shifts
    that the test does not refuse.

    Args:
        first: shape (n,), finite.
        second: shape (m,), finite.
        level: one minus the confidence of the interval.

    Returns:
        The estimate; without interval where the seeds are too few for that level.

    Source: Hodges and Lehmann (1963), "Estimates of location based on rank tests"; Lehmann (1975),
    "Nonparametrics", section 2.6.
    """
    n, m = len(first), len(second)
    if min(n, m) == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    apart = differences(first[:, None], second).ravel()
    middle = float(np.median(apart))
    places = interval_places(n, m, level)
    if places is None:
        return Estimate(middle, np.nan, np.nan, min(n, m))
    low, high = np.partition(apart, places)[list(places)]
    return Estimate(middle, float(low), float(high), min(n, m))


@lru_cache(maxsize=4096)
def interval_places(n: int, m: int, level: float) -> tuple[int, int] | None:
    """Where, among the n m ordered differences, the interval of the typical one begins and ends.

    None where the seeds are too few for the level.
    """
    if 0.5 ** min(n, m) > level:
        return None
    if n + m <= MOST_COUNTED:
        chances = rank_sum_tail((1,) * (n + m), n)
        # From the largest rank sum down, one won pair fewer at each step of two.
        tails = chances[n * (n + 1 + 2 * m) :: -2][: n * m + 1]
        cut = int((2 * tails <= level).sum())
    else:
        spread = (n * m * (n + m + 1) / 12) ** 0.5
        cut = int(n * m / 2 - stats.norm.isf(level / 2) * spread)
    return (cut - 1, n * m - cut) if cut >= 1 else None
