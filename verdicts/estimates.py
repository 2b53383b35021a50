"""Mean, median and interquartile mean of scores, with their intervals over seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from verdicts.bootstrap import (
    N_RESAMPLES,
    as_columns,
    enough_resamples,
    interval_tail,
    percentile_interval,
    resample_counts,
)
from verdicts.score_arrays import Counts, Floats

Statistic = Literal["mean", "median", "iqm"]

# How many of n sorted values each statistic leaves out at each end, before it takes the mean.
_CUTS: dict[Statistic, Callable[[int], int]] = {
    "mean": lambda n: 0,
    "median": lambda n: (n - 1) // 2,
    "iqm": lambda n: n // 4,
}


@dataclass(frozen=True)
class Estimate:
    """A figure and how sure it is.

    Attributes:
        point: the figure; NaN where there is nothing to compute it from.
        low, high: the ends of its interval; both NaN where there is none, as with a single seed.
        n: the number of values that it is computed from.
        n_missing: the number of values left out, from runs that failed.
    """

    point: float
    low: float
    high: float
    n: int
    n_missing: int = 0

    @property
    def has_interval(self) -> bool:
        """Whether there were seeds enough for an interval."""
        return not np.isnan(self.low)


@dataclass(frozen=True)
class Summary:
    """Where the scores of an agent lie.

    Attributes:
        mean: what the next run is expected to score.
        median: what half of the runs exceed.
        iqm: the interquartile mean: the mean of the middle half of the runs.
    """

    mean: Estimate
    median: Estimate
    iqm: Estimate


def summarise(
    scores: ArrayLike, *, seed: int, confidence: float = 0.95, n_resamples: int = N_RESAMPLES
) -> Summary:
    """The three statistics of an agent's scores.

    Over several environments the runs are pooled, each environment weighing the same, also where
    runs of it are missing. Seeds are resampled within each environment by itself. The median is
    therefore that of the runs, and not that of the environments' means.

    Args:
        scores: shape (n_seeds,), or (n_seeds, n_envs) on a scale that the environments share. What
            is not finite counts as missing. Where an environment has no score at all the figures
            are NaN: leave it out for every agent, or say what a failed run is worth.
        seed: of the resampling.
        confidence: of the intervals.
        n_resamples: how many resamples they come from; fewer with hundreds of seeds.

    Raises:
        ValueError: for arguments out of range or of another shape.

    Source: Agarwal et al. (2021), "Deep reinforcement learning at the edge of the statistical
    precipice", NeurIPS. The intervals are widened for few seeds, see ``interval_tail``.
    """
    resampled = _resample(scores, seed, confidence, n_resamples)
    return Summary(
        resampled.estimate("mean"), resampled.estimate("median"), resampled.estimate("iqm")
    )


def estimate(
    scores: ArrayLike,
    statistic: Statistic,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> Estimate:
    """One of the statistics alone; all else as in ``summarise``."""
    return _resample(scores, seed, confidence, n_resamples).estimate(statistic)


@dataclass(frozen=True)
class _Resampled:
    """Pooled scores in order, and how much each resample weighs them.

    Attributes:
        values: ascending, shape (n,).
        weights: cumulated over ``values``, shape (1 + n_resamples, n), the scores as they are
            first. A row ends at n.
        tail: what an interval leaves out on each side.
        n_missing: scores left out.
    """

    values: Floats
    weights: Floats
    tail: float
    n_missing: int

    def estimate(self, statistic: Statistic) -> Estimate:
        n = len(self.values)
        if not self.weights.size:
            return Estimate(np.nan, np.nan, np.nan, n, self.n_missing)
        means = _trimmed_means(self.values, self.weights, _CUTS[statistic](n))
        low, high = percentile_interval(means[1:], self.tail)
        return Estimate(float(means[0]), float(low), float(high), n, self.n_missing)


def _resample(scores: ArrayLike, seed: int, confidence: float, n_resamples: int) -> _Resampled:
    columns = as_columns(scores)
    strata = [column[np.isfinite(column)] for column in columns.T]
    tail = interval_tail(strata, confidence)
    values = np.concatenate(strata)
    n_missing = columns.size - values.size
    if any(len(stratum) == 0 for stratum in strata):
        return _Resampled(values, np.empty((0, 0)), tail, n_missing)
    n_resamples = enough_resamples(n_resamples, max(map(len, strata)))
    if values.min() == values.max():
        n_resamples = 1  # all are alike
    sizes = tuple(map(len, strata))
    counts = [
        np.vstack([np.ones(n, dtype=np.int64), drawn]) * (len(values) / (len(strata) * n))
        for n, drawn in zip(sizes, _drawn(sizes, n_resamples, seed), strict=True)
    ]
    order = np.argsort(values)
    return _Resampled(values[order], np.hstack(counts)[:, order].cumsum(axis=1), tail, n_missing)


# Agents of a study have as many seeds, and several figures each.
@lru_cache(maxsize=1)
def _drawn(sizes: tuple[int, ...], n_resamples: int, seed: int) -> tuple[Counts, ...]:
    """Resamples of each stratum; nobody changes them."""
    rng = np.random.default_rng(seed)
    return tuple(resample_counts(n, n_resamples, rng) for n in sizes)


def _trimmed_means(values: Floats, weights: Floats, cut: int) -> Floats:
    """The mean of each resample's values without ``cut`` of them at either end.

    Args:
        values: ascending, shape (n,).
        weights: cumulated over ``values``, shape (n_resamples, n).
        cut: weight to leave out at each end.
    """
    n = len(values)
    below = np.clip(weights[:, :-1], cut, n - cut)
    # The weighted sum, by parts. Counting from the smallest value keeps equal values exact.
    above_smallest = (n - cut) * (values[-1] - values[0]) - below @ np.diff(values)
    return np.asarray(values[0] + above_smallest / (n - 2 * cut))
