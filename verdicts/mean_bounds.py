"""How low a mean can be, for sure: of bounded values, whatever their distribution."""

from __future__ import annotations

import math

import numpy as np

from verdicts.score_arrays import Floats


def least_mean(values: Floats, low: float, high: float, level: float) -> float:
    """A number that is above the mean that values are drawn with in at most ``level`` of all cases.

    It takes nothing for granted but that no value lies outside ``low`` and ``high``: not even that
    what was never seen among so many is rare.

    Args:
        values: drawn independently, shape (n,) with n > 1.
        low: the least that a value can be.
        high: the greatest.
        level: how often the bound may be too high.

    Source: Maurer and Pontil (2009), "Empirical Bernstein bounds and sample variance penalization",
    theorem 4.
    """
    n, doubt = len(values), math.log(2 / level)
    by_spread = math.sqrt(2 * float(values.var(ddof=1)) * doubt / n)
    by_range = 7 * (high - low) * doubt / (3 * (n - 1))
    return float(np.mean(values)) - by_spread - by_range
