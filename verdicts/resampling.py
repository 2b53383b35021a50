"""Scores, their means and medians, and intervals by resampling seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]  # how often something was drawn


# Resampling of seeds, separately within each environment.
#
# A resample is stored as the count of each seed. Sums over resamples are then matrix products,
# and sorting is done once and not once per resample.

# Intervals over few seeds end beyond the 1 % quantiles: with fewer resamples they vary too much.
N_RESAMPLES = 10_000
# Intervals over many seeds end further inside, and need fewer resamples.
ENOUGH_RESAMPLES = 1_000
_MOST_DRAWS = 2_000_000
_MOST_AT_ONCE = 4_000_000  # draws in memory; more are drawn in pieces
_PIECE = 1_000_000


def as_columns(scores: ArrayLike) -> Floats:
    """Scores of shape (n_seeds,) or (n_seeds, n_envs) as a table, an environment per column."""
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim not in {1, 2} or table.size == 0:
        raise ValueError(
            f"scores have shape {table.shape}, they must have (n_seeds,) or (n_seeds, n_envs)"
        )
    return table[:, None] if table.ndim == 1 else table


def check_confidence(confidence: float) -> None:
    """Refuse a confidence outside of 0 to 1, such as 95."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, it must lie between 0 and 1, as 0.95 does")


def resample_counts(n: int, n_resamples: int, rng: np.random.Generator) -> Counts:
    """How often each of ``n`` seeds occurs in each resample, shape (n_resamples, n)."""
    drawn = rng.integers(n, size=(n_resamples, n)) + n * np.arange(n_resamples)[:, None]
    return np.bincount(drawn.ravel(), minlength=n_resamples * n).reshape(n_resamples, n)


def enough_resamples(n_resamples: int, n_seeds: int) -> int:
    """The number of resamples: ``n_resamples``, or fewer where there are many seeds to draw."""
    return min(n_resamples, max(ENOUGH_RESAMPLES, _MOST_DRAWS // n_seeds))


def interval_tail(strata: Sequence[Floats], confidence: float) -> float:
    """The share of resamples that an interval leaves out on each side.

    Percentiles of the bootstrap distribution are too narrow for few seeds: it uses the variance
    with n in the denominator instead of n - 1, and the normal instead of the t distribution. The
    share is widened for both, so that the interval for a mean is about as long as the t interval;
    over several environments, with the degrees of freedom of Welch and Satterthwaite. NaN where
    an environment has fewer than two seeds, so that there is no interval.

    Source: Hesterberg (2015), "What teachers should know about the bootstrap", The American
    Statistician 69(4), the expanded percentile interval.
    """
    check_confidence(confidence)
    sizes = np.array([len(values) for values in strata])
    if sizes.min() < 2:
        return float("nan")
    tail = (1 - confidence) / 2
    variances = np.array([values.var(ddof=1) for values in strata]) / sizes
    if not variances.any():
        return tail
    variances /= variances.max()
    degrees = variances.sum() ** 2 / (variances**2 / (sizes - 1)).sum()
    widening = np.sqrt(variances.sum() / (variances * (sizes - 1) / sizes).sum())
    return float(stats.norm.sf(widening * stats.t.isf(tail, degrees)))


def percentile_interval(resampled: Floats, tail: float) -> tuple[Floats, Floats]:
    """The quantiles ``tail`` and 1 - ``tail`` over the first axis, NaN where ``tail`` is."""
    if np.isnan(tail):
        nothing = np.full(resampled.shape[1:], np.nan)
        return nothing, nothing
    low, high = np.quantile(resampled, [tail, 1 - tail], axis=0)
    return low, high


# Mean, median and interquartile mean of scores, with their intervals over seeds.

Statistic = Literal["mean", "median", "iqm"]

# How many of n sorted values each statistic leaves out at each end, before it takes the mean.
_CUTS: dict[Statistic, Callable[[int], int]] = {
    "mean": lambda n: 0,
    "median": lambda n: (n - 1) // 2,
    "iqm": lambda n: n // 4,
}


@dataclass(frozen=True)
class Estimate:
    """An estimate with its confidence interval."""

    point: float  #: the estimate; NaN where there is nothing to compute it from
    low: float  #: the lower end of its interval; NaN where there is none, as with a single seed
    high: float  #: the upper end, likewise
    n: int  #: the number of values that it is computed from
    n_missing: int = 0  #: the number of values left out, from runs that failed

    @property
    def has_interval(self) -> bool:
        """Whether there were seeds enough for an interval."""
        return not np.isnan(self.low)


@dataclass(frozen=True)
class Summary:
    """Mean, median and interquartile mean of an agent's scores."""

    mean: Estimate  #: what the next run is expected to score
    median: Estimate  #: what half of the runs exceed
    iqm: Estimate  #: the interquartile mean: the mean of the middle half of the runs


def summarise(
    scores: ArrayLike, *, seed: int, confidence: float = 0.95, n_resamples: int = N_RESAMPLES
) -> Summary:
    """The three statistics of an agent's scores.

    Over several environments the runs are pooled, each environment with the same weight, even if
    some of its runs are missing. Seeds are resampled separately within each environment. The median
    is therefore that of the runs, and not that of the environments' means.

    Args:
        scores: shape (n_seeds,), or (n_seeds, n_envs) on a scale that the environments share.
            Non-finite scores count as missing. Where an environment has no score at all the
            estimates are NaN: leave it out for every agent, or give failed runs a score.
        seed: the seed of the resampling.
        confidence: the confidence level of the intervals.
        n_resamples: how many resamples they come from; fewer with hundreds of seeds.

    Raises:
        ValueError: for arguments out of range or of another shape.

    Source: Agarwal et al. (2021), "Deep reinforcement learning at the edge of the statistical
    precipice", NeurIPS. The intervals are widened for few seeds, see ``interval_tail``.
    """
    return Summary(*_estimates(scores, ("mean", "median", "iqm"), seed, confidence, n_resamples))


def estimate(
    scores: ArrayLike,
    statistic: Statistic,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> Estimate:
    """One of the statistics alone; all else as in ``summarise``."""
    return _estimates(scores, (statistic,), seed, confidence, n_resamples)[0]


def _estimates(
    scores: ArrayLike,
    statistics: Sequence[Statistic],
    seed: int,
    confidence: float,
    n_resamples: int,
) -> list[Estimate]:
    columns = as_columns(scores)
    strata = [column[np.isfinite(column)] for column in columns.T]
    tail = interval_tail(strata, confidence)
    values = np.concatenate(strata)
    n, n_missing = len(values), columns.size - values.size
    if any(len(stratum) == 0 for stratum in strata):
        return [Estimate(np.nan, np.nan, np.nan, n, n_missing) for _ in statistics]
    n_resamples = enough_resamples(n_resamples, max(map(len, strata)))
    if values.min() == values.max():
        n_resamples = 1  # all are alike
    order = np.argsort(values)
    found: dict[Statistic, list[Floats]] = {statistic: [] for statistic in statistics}
    sizes = tuple(map(len, strata))
    for drawn in drawn_in_pieces(sizes, n_resamples, seed):
        counts = [
            (each if found[statistics[0]] else np.vstack([np.ones(size, dtype=np.int64), each]))
            * (n / (len(strata) * size))
            for size, each in zip(sizes, drawn, strict=True)
        ]
        # The cumulated weights of the sorted scores in each resample; the first row is the original
        # sample. A row ends at n.
        weights = np.hstack(counts)[:, order].cumsum(axis=1)
        for statistic, means in found.items():
            means.append(_trimmed_means(values[order], weights, _CUTS[statistic](n)))
    estimates = []
    for pieces in found.values():
        first, *resampled = np.concatenate(pieces)
        low, high = percentile_interval(np.array(resampled), tail)
        estimates.append(Estimate(float(first), float(low), float(high), n, n_missing))
    return estimates


def drawn_in_pieces(
    sizes: tuple[int, ...], n_resamples: int, seed: int
) -> Iterator[tuple[Counts, ...]]:
    """Resamples of strata, in pieces that fit into memory; callers must not change them."""
    if n_resamples * sum(sizes) <= _MOST_AT_ONCE:
        yield _drawn(sizes, n_resamples, seed)
        return
    at_once = max(_PIECE // sum(sizes), 1)
    generators = [np.random.default_rng([seed, place]) for place in range(len(sizes))]
    for start in range(0, n_resamples, at_once):
        n = min(at_once, n_resamples - start)
        yield tuple(
            resample_counts(size, n, rng) for size, rng in zip(sizes, generators, strict=True)
        )


# Agents of a study have equally many seeds, so that one draw serves all agents and statistics.
@lru_cache(maxsize=1)
def _drawn(sizes: tuple[int, ...], n_resamples: int, seed: int) -> tuple[Counts, ...]:
    """Resamples of each stratum."""
    rng = np.random.default_rng(seed)
    return tuple(resample_counts(n, n_resamples, rng) for n in sizes)


def _trimmed_means(values: Floats, weights: Floats, cut: int) -> Floats:
    """The mean of each resample's values without ``cut`` of them at either end."""
    n = len(values)
    below = np.clip(weights[:, :-1], cut, n - cut)
    # The weighted sum, by parts. Counting from the smallest value keeps equal values exact.
    above_smallest = (n - cut) * (values[-1] - values[0]) - below @ np.diff(values)
    return np.asarray(values[0] + above_smallest / (n - 2 * cut))


# Returns measured against the best possible and the best random or constant policy.
#
# The same scale as `pipeline.evaluation.sampled.Yardstick`, for arrays.


def optimum_score(returns: ArrayLike, optimum: float, baseline: float) -> Floats:
    """Returns on a scale where 1 is the optimum and 0 the baseline, elementwise.

    Args:
        returns: expected returns, of any shape; NaN stays.
        optimum: the highest expected return of any policy.
        baseline: that of the best random or constant policy. Where no policy beats it,
            a return scores 1 if it reaches the optimum, and else 0.
    """
    figures = np.asarray(returns, dtype=np.float64)
    if optimum == baseline:
        return np.where(np.isnan(figures), np.nan, figures >= optimum)
    return (figures - baseline) / (optimum - baseline)
