"""Figures over the runs of one agent, with their intervals. Nothing here is random.

Runs without a figure are given as NaN: they are left out and counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

Floats = NDArray[np.float64]
Bounds = tuple[float, float]  # the least and the greatest possible figure

UNBOUNDED: Bounds = (-np.inf, np.inf)
FEW = 5  # with fewer runs, the range of the runs stands in place of an interval
SAME = 1e-12  # relative differences below this are rounding
LEVEL = 0.05  # one minus the confidence of an interval that stands alone


@dataclass(frozen=True)
class Estimate:
    """A figure over runs with its 95 % interval, or with their range below five runs."""

    point: float  #: the figure; NaN where there is nothing to compute it from
    low: float  #: the lower end; the same as ``point`` where all runs are equal
    high: float  #: the upper end, likewise
    n: int  #: the number of runs
    n_missing: int = 0  #: the number of runs without a figure

    @property
    def is_range(self) -> bool:
        """Whether the ends are the lowest and the highest run, and not an interval."""
        return self.n < FEW


@dataclass(frozen=True)
class Summary:
    """Mean, median and interquartile mean of an agent's runs."""

    mean: Estimate
    median: Estimate
    iqm: float  #: mean of the middle half of the runs (Agarwal et al., 2021)


def finite(values: ArrayLike) -> Floats:
    """The finite values, shape (n,)."""
    array = np.asarray(values, np.float64).ravel()
    return array[np.isfinite(array)]


def mean_and_variance(runs: Floats) -> tuple[float, float]:
    """Mean and unbiased variance of finite runs, exact where all are equal; NaN without runs."""
    if not len(runs):
        return np.nan, np.nan
    if np.ptp(runs) <= SAME * max(1.0, float(np.abs(runs).max())):
        return float(runs[0]), 0.0
    return float(runs.mean()), float(runs.var(ddof=1))


def t_reach(n: ArrayLike, variance: ArrayLike, level: float = LEVEL) -> Floats:
    """Half the length of Student's t interval of a mean, elementwise; n is at least 2."""
    runs = np.asarray(n, np.float64)
    quantile = special.stdtrit(runs - 1, 1 - level / 2)
    return np.asarray(quantile * np.sqrt(np.asarray(variance) / runs))


def mean_over_runs(values: ArrayLike, bounds: Bounds = UNBOUNDED) -> Estimate:
    """The mean of an agent's runs with Student's t interval, cut at what is possible.

    Args:
        values: one for each run, shape (n_runs,); NaN for a run without a figure.
        bounds: the least and the greatest possible value.
    """
    runs = finite(values)
    n, n_missing = len(runs), np.size(values) - len(runs)
    mean, variance = mean_and_variance(runs)
    if n == 0 or variance == 0:
        return Estimate(mean, mean, mean, n, n_missing)
    if n < FEW:
        return Estimate(mean, float(runs.min()), float(runs.max()), n, n_missing)
    reach = float(t_reach(n, variance))
    low, high = max(mean - reach, bounds[0]), min(mean + reach, bounds[1])
    # A figure outside of the bounds, by rounding or by wrong bounds, keeps its place.
    return Estimate(mean, min(low, mean), max(high, mean), n, n_missing)


def median_over_runs(values: ArrayLike) -> Estimate:
    """The median of an agent's runs; its interval goes from one run to another.

    It holds for every distribution; the whole range below six runs. Infinite values count: a run
    that never arrives is later than all others.
    """
    array = np.asarray(values, np.float64).ravel()
    ordered = np.sort(array[~np.isnan(array)])
    n, n_missing = len(ordered), array.size - len(ordered)
    if n == 0:
        return Estimate(np.nan, np.nan, np.nan, 0, n_missing)
    # How many runs to leave out at each end: fewer than the lower quantile of Binomial(n, 1/2).
    cut = max(int((special.bdtr(np.arange(n), n, 0.5) <= LEVEL / 2).sum()) - 1, 0)
    return Estimate(
        float(np.median(ordered)), float(ordered[cut]), float(ordered[n - 1 - cut]), n, n_missing
    )


def summarise(values: ArrayLike, bounds: Bounds = UNBOUNDED) -> Summary:
    """Mean, median and interquartile mean of an agent's runs, shape (n_runs,)."""
    runs = np.sort(finite(values))
    middle = runs[len(runs) // 4 : len(runs) - len(runs) // 4]
    iqm = mean_and_variance(middle)[0]
    return Summary(mean_over_runs(values, bounds), median_over_runs(finite(values)), iqm)


def share_interval(count: int, n: int) -> tuple[float, float]:
    """The interval of a share of which ``count`` of ``n`` were seen.

    Source: Clopper and Pearson (1934), "The use of confidence or fiducial limits illustrated in the
    case of the binomial", Biometrika 26.
    """
    low = 0.0 if count == 0 else float(special.betaincinv(count, n - count + 1, LEVEL / 2))
    high = 1.0 if count == n else float(special.betaincinv(count + 1, n - count, 1 - LEVEL / 2))
    return low, high


def unseen_share(n: int) -> float:
    """The largest share of further runs that may be of a kind that none of ``n`` runs showed."""
    return 1 - LEVEL ** (1 / n) if n else 1.0
