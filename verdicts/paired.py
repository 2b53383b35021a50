"""Differences between two agents on the same seeds: how large."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.bootstrap import check_confidence
from verdicts.estimates import Estimate
from verdicts.score_arrays import Floats

# Exact returns of two policies that are equally good can differ in their last bits.
SAME = 1e-12


def differences(first: Floats, second: Floats) -> Floats:
    """``first`` - ``second``, exactly 0 where they agree to twelve digits."""
    with np.errstate(invalid="ignore"):  # two infinite scores are equal
        apart = first - second
        same = np.abs(apart) <= SAME * np.maximum(np.abs(first), np.abs(second))
    return np.where(same | (first == second), 0.0, apart)


def same_shape(first: Floats, second: Floats) -> None:
    """Refuse scores that do not pair up.

    Raises:
        ValueError: if the shapes differ.
    """
    if first.shape != second.shape:
        raise ValueError(
            f"scores of shapes {first.shape} and {second.shape} do not pair up: give both agents "
            "the same seeds, and NaN for a run that failed"
        )


def paired_difference(first: ArrayLike, second: ArrayLike, confidence: float = 0.95) -> Estimate:
    """The mean of ``first`` - ``second`` over seeds, with the paired t interval.

    In simulations with 5 to 30 seeds the 95 % interval covered the mean in 93 to 97 % of the cases
    where differences are symmetric or two-peaked, and in 82 to 94 % where they are strongly skewed
    (exponential, log-normal). BCa covered 80 to 95 % and 75 to 92 %, and least with 5 seeds. With
    failures too rare to have shown up, no interval can cover.

    Args:
        first: shape (n_seeds,).
        second: likewise, the same seeds at the same places. A seed counts where both are finite.
        confidence: of the interval.

    Returns:
        The estimate, without interval for fewer than two seeds. Where all differences are equal the
        interval is the point.

    Raises:
        ValueError: for arguments out of range, or shapes that do not pair up.
    """
    check_confidence(confidence)
    apart = paired_differences(first, second)
    n_missing = np.size(first) - len(apart)
    mean, spread = mean_and_spread(apart)
    half = _half_width(spread, len(apart), confidence)
    return Estimate(mean, mean - half, mean + half, len(apart), n_missing)


def holm(p_values: ArrayLike) -> Floats:
    """P-values corrected for how many there are: those below 0.05 hold jointly with 95 %.

    Args:
        p_values: shape (n_tests,). NaN stands for a test that could not be made, and stays.

    Returns:
        The corrected ones, in the same order.

    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".
    """
    adjusted = np.array(p_values, dtype=np.float64)
    made = np.flatnonzero(~np.isnan(adjusted))
    order = made[np.argsort(adjusted[made], kind="stable")]
    stepped = adjusted[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1)
    return adjusted


def paired_differences(first: ArrayLike, second: ArrayLike) -> Floats:
    """The differences on the seeds where both agents have a finite score, shape (n,).

    Raises:
        ValueError: unless both have the same shape (n_seeds,).
    """
    x, y = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    same_shape(x, y)
    if x.ndim != 1:
        raise ValueError(f"scores to be paired have shape {x.shape}, they must have (n_seeds,)")
    both = np.isfinite(x) & np.isfinite(y)
    return differences(x[both], y[both])


def mean_and_spread(values: Floats) -> tuple[float, float]:
    """Mean and standard deviation; NaN where there are too few values for them.

    Counted from the first value, so that equal values have a spread of exactly 0.
    """
    if len(values) == 0:
        return float("nan"), float("nan")
    offsets = values - values[0]
    spread = offsets.std(ddof=1) if len(values) > 1 else np.nan
    return float(values[0] + offsets.mean()), float(spread)


def _half_width(spread: float, n: int, confidence: float) -> float:
    """How far the t interval of a mean of ``n`` values reaches to each side."""
    if n < 2:
        return float("nan")
    return float(stats.t.isf((1 - confidence) / 2, n - 1) * spread / np.sqrt(n))
