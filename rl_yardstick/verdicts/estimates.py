"""Figures over the runs of one agent, with their intervals."""

from __future__ import annotations

from collections.abc import Iterable
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


@dataclass(frozen=True)
class AgentRuns:
    """The runs of an agent in an environment. Its intervals hold alone, in 95 % of cases."""

    environment: str
    name: str
    n: int  #: runs with a score
    n_missing: int
    mean: float
    mean_interval: Bounds  #: Student's t, cut at the bounds; the range below five runs
    median: float
    failed: int | None  #: runs below ``Study.failure_threshold``; None where that is not known
    failed_interval: Bounds  #: of the share of runs that fail
    unseen: float  #: the largest share of further runs of a kind that no run showed


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


def t_reach(n: float, variance: float, level: float = LEVEL) -> float:
    """Half the length of Student's t interval of a mean; n is at least 2."""
    return float(special.stdtrit(n - 1, 1 - level / 2) * np.sqrt(variance / n))


def mean_over_runs(values: ArrayLike, bounds: Bounds = UNBOUNDED) -> Estimate:
    """The mean of an agent's runs, shape (n_runs,), with Student's t interval cut at the bounds."""
    runs = finite(values)
    n, n_missing = len(runs), np.size(values) - len(runs)
    mean, variance = mean_and_variance(runs)
    if n == 0 or variance == 0:
        return Estimate(mean, mean, mean, n, n_missing)
    if n < FEW:
        return Estimate(mean, float(runs.min()), float(runs.max()), n, n_missing)
    reach = t_reach(n, variance)
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
    low, high = float(ordered[cut]), float(ordered[n - 1 - cut])
    return Estimate(float(np.median(ordered)), low, high, n, n_missing)


def summarise(values: ArrayLike, bounds: Bounds = UNBOUNDED) -> Summary:
    """Mean, median and interquartile mean of an agent's runs, shape (n_runs,)."""
    runs = np.sort(finite(values))
    middle = runs[len(runs) // 4 : len(runs) - len(runs) // 4]
    mean, median = mean_over_runs(values, bounds), median_over_runs(runs)
    return Summary(mean, median, iqm=mean_and_variance(middle)[0])


def share_interval(count: int, n: int) -> tuple[float, float]:
    """The interval of a share of which ``count`` of ``n`` were seen: Clopper and Pearson (1934)."""
    low = 0.0 if count == 0 else float(special.betaincinv(count, n - count + 1, LEVEL / 2))
    high = 1.0 if count == n else float(special.betaincinv(count + 1, n - count, 1 - LEVEL / 2))
    return low, high


def unseen_share(n: int) -> float:
    """The largest share of further runs that may be of a kind that none of ``n`` runs showed."""
    return 1 - LEVEL ** (1 / n) if n else 1.0


def failure_threshold(baseline: float | None, scores: Iterable[ArrayLike]) -> float:
    """The score below which a run failed: half the way from the baseline to the best median.

    NaN where no median is above the baseline, or that is not known: failures have no meaning there.
    """
    medians = [float(np.median(runs)) for runs in map(finite, scores) if len(runs)]
    best = max(medians, default=np.nan)
    return (baseline + best) / 2 if baseline is not None and best > baseline else np.nan


def describe(
    environment: str, name: str, values: ArrayLike, ends: Bounds, threshold: float
) -> AgentRuns:
    """The runs of an agent; those below the threshold failed."""
    runs, mean = finite(values), mean_over_runs(values, ends)
    failed = None if np.isnan(threshold) else int((runs < threshold).sum())
    return AgentRuns(
        environment,
        name,
        n=len(runs),
        n_missing=mean.n_missing,
        mean=mean.point,
        mean_interval=(mean.low, mean.high),
        median=float(np.median(runs)) if len(runs) else np.nan,
        failed=failed,
        failed_interval=(0.0, 1.0) if failed is None else share_interval(failed, len(runs)),
        unseen=unseen_share(len(runs)),
    )
