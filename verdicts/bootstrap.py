"""Resampling of seeds, within each environment apart from the others.

A resample is kept as how often it drew each seed. Sums over resamples are then matrix products, and
sorting is done once and not once per resample.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.score_arrays import Counts, Floats

# The ends of an interval over few seeds lie beyond the 1 % quantiles: fewer would vary too much.
N_RESAMPLES = 10_000
# Those over many seeds lie further in, and need fewer.
ENOUGH_RESAMPLES = 1_000
_MOST_DRAWS = 2_000_000


def as_columns(scores: ArrayLike) -> Floats:
    """Scores as a table with one environment per column.

    Args:
        scores: shape (n_seeds,) or (n_seeds, n_envs).

    Raises:
        ValueError: for another shape, or where there is nothing.
    """
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim not in {1, 2} or table.size == 0:
        raise ValueError(
            f"scores have shape {table.shape}, they must have (n_seeds,) or (n_seeds, n_envs)"
        )
    return table[:, None] if table.ndim == 1 else table


def check_confidence(confidence: float) -> None:
    """Refuse a confidence that is no share, as 95 would be.

    Raises:
        ValueError: unless it lies strictly between 0 and 1.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, it must lie between 0 and 1, as 0.95 does")


def resample_counts(n: int, n_resamples: int, rng: np.random.Generator) -> Counts:
    """How often each of ``n`` seeds occurs in each resample, shape (n_resamples, n)."""
    drawn = rng.integers(n, size=(n_resamples, n)) + n * np.arange(n_resamples)[:, None]
    return np.bincount(drawn.ravel(), minlength=n_resamples * n).reshape(n_resamples, n)


def enough_resamples(n_resamples: int, n_seeds: int) -> int:
    """So many resamples as are asked for, or fewer where there are many seeds to draw."""
    return min(n_resamples, max(ENOUGH_RESAMPLES, _MOST_DRAWS // n_seeds))


def interval_tail(strata: Sequence[Floats], confidence: float) -> float:
    """The share of resamples that an interval leaves out on each side.

    Percentiles of the bootstrap distribution are too narrow for few seeds: it uses the variance
    with n in the denominator instead of n - 1, and the normal instead of the t distribution. The
    share is widened for both, so that the interval for a mean is about as long as the t interval;
    over several environments, with the degrees of freedom of Welch and Satterthwaite.

    Args:
        strata: the values of each environment that the statistic varies with, one per seed.
        confidence: of the interval.

    Returns:
        The share; NaN where an environment has fewer than two seeds, so that there is no interval.

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
