"""Figures of learning curves: evaluations of one run, at growing steps or episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.bootstrap import (
    check_confidence,
    enough_resamples,
    interval_tail,
    percentile_interval,
    resample_counts,
)
from verdicts.estimates import Estimate
from verdicts.score_arrays import Floats

# As many points as a figure can show.
_MOST_POINTS = 500


@dataclass(frozen=True)
class Band:
    """A curve with an interval at each point, each of shape (n_points,); NaN as in ``Estimate``."""

    point: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class ThresholdSummary:
    """How soon runs reach a threshold, where some never do.

    Attributes:
        median: steps to the threshold, a run that never reaches it counting as later than all
            others; infinite where half of the runs or more do not.
        share_reached: the share of runs that reach it.
    """

    median: Estimate
    share_reached: Estimate


def area_under_curve(steps: ArrayLike, values: ArrayLike) -> Floats:
    """The mean height of a curve over its span, in the unit of its values.

    The trapezoidal rule, divided by the span. To compare curves that were evaluated at different
    points, put them ``on_grid`` first.

    Args:
        steps: shape (n_points,), not falling.
        values: shape (n_points,) or (n_curves, n_points).

    Returns:
        Shape () or (n_curves,); the last value where the span is 0.

    Raises:
        ValueError: for steps that fall, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    if x[-1] == x[0]:
        return y[..., -1]
    return np.asarray(np.trapezoid(y, x, axis=-1) / (x[-1] - x[0]))


def final_score(values: ArrayLike) -> Floats:
    """The last value of each curve: shape (..., n_points) to (...)."""
    return np.asarray(values, dtype=np.float64)[..., -1]


def best_score(values: ArrayLike) -> Floats:
    """The largest value of each curve: shape (..., n_points) to (...).

    Where the evaluations are sampled, it is too high by the luck of the best of them.
    """
    return np.asarray(np.fmax.reduce(np.asarray(values, dtype=np.float64), axis=-1))


def shared_grid(curves: Sequence[ArrayLike], n_points: int = _MOST_POINTS) -> Floats:
    """Steps at which several curves can be compared.

    Args:
        curves: the steps of each curve, not falling.
        n_points: how many points to return at most.

    Returns:
        The evaluation points of all curves, within the span that all of them cover; evenly spaced
        points of that span where those are too many.

    Raises:
        ValueError: where there is no such span.
    """
    steps = [np.asarray(curve, dtype=np.float64) for curve in curves]
    if not steps or min(map(len, steps)) == 0:
        raise ValueError("a curve without evaluations shares no steps with the others")
    start, end = max(curve[0] for curve in steps), min(curve[-1] for curve in steps)
    if start > end:
        raise ValueError(
            f"one curve ends at step {end:g} and another begins at step {start:g}: they share none"
        )
    points = np.unique(np.concatenate([*steps, [start, end]]))
    points = points[(start <= points) & (points <= end)]
    return points if len(points) <= n_points else np.linspace(start, end, n_points)


def on_grid(steps: ArrayLike, values: ArrayLike, grid: ArrayLike) -> Floats:
    """A curve at other steps: at each, the latest evaluation so far.

    Nothing is read off between evaluations, because nothing is known of it.

    Args:
        steps: shape (n_points,), not falling.
        values: shape (n_points,) or (n_curves, n_points).
        grid: shape (n_grid,).

    Returns:
        Shape (n_grid,) or (n_curves, n_grid); NaN before the first evaluation.

    Raises:
        ValueError: for steps that fall, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    latest = np.searchsorted(x, np.asarray(grid, dtype=np.float64), side="right") - 1
    return np.where(latest < 0, np.nan, y[..., np.maximum(latest, 0)])


def curve_band(
    values: ArrayLike, *, seed: int, confidence: float = 0.95, n_resamples: int = 2000
) -> Band:
    """The mean over seeds at each point, with intervals that hold point by point.

    They are those that ``estimate`` gives each point by itself.

    Args:
        values: shape (n_seeds, n_points), on a common grid. What is not finite is left out at its
            point.
        seed: of the resampling, which draws the same seeds at every point.
        confidence: of the intervals.
        n_resamples: how many resamples they come from.

    Raises:
        ValueError: for arguments out of range.
    """
    table = np.asarray(values, dtype=np.float64)
    known = np.isfinite(table)
    band = np.full((3, table.shape[1]), np.nan)
    # Points that have the same seeds are resampled together: mostly all of them.
    for there in np.unique(known, axis=1).T:
        if there.any():
            places = (known == there[:, None]).all(axis=0)
            columns = table[there][:, places]
            band[:, places] = _resampled_means(columns, seed, confidence, n_resamples)
    return Band(*band)


def _resampled_means(columns: Floats, seed: int, confidence: float, n_resamples: int) -> Floats:
    """Mean, low and high end at each point, shape (3, n_points), of (n_seeds, n_points)."""
    n = len(columns)
    rng = np.random.default_rng(seed)
    counts = resample_counts(n, enough_resamples(n_resamples, n), rng)
    # Counted from the smallest value, so that equal values keep theirs exactly.
    least = columns.min(axis=0)
    above = columns - least
    resampled = least + (counts @ above) / n
    tail = interval_tail([np.arange(n, dtype=np.float64)], confidence)
    return np.array([least + above.mean(axis=0), *percentile_interval(resampled, tail)])


def steps_to_threshold(steps: ArrayLike, values: ArrayLike, threshold: float) -> float:
    """The step of the first evaluation whose value is at least the threshold.

    Args:
        steps: shape (n_points,), not falling.
        values: shape (n_points,).
        threshold: in the unit of the values.

    Returns:
        The step; infinity if no evaluation reaches the threshold, NaN if there is no evaluation.

    Raises:
        ValueError: for steps that fall, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    if np.isnan(y).all():
        return float("nan")
    reached = y >= threshold
    return float(x[reached.argmax()]) if reached.any() else float("inf")


def steps_to_stay(steps: ArrayLike, values: ArrayLike, threshold: float) -> float:
    """The first evaluation from which on a curve keeps to a threshold.

    A curve that fluctuates crosses it by luck long before; with many evaluations nearly any does.

    Args:
        steps: shape (n_points,), not falling.
        values: shape (n_points,).
        threshold: in the unit of the values.

    Returns:
        The step; infinity if the last evaluation is below the threshold, NaN if there is none.

    Raises:
        ValueError: for steps that fall, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    if np.isnan(y).all():
        return float("nan")
    x, y = x[~np.isnan(y)], y[~np.isnan(y)]
    below = np.flatnonzero(y < threshold)
    first = below[-1] + 1 if len(below) else 0
    return float(x[first]) if first < len(x) else float("inf")


def summarise_steps(steps: ArrayLike, confidence: float = 0.95) -> ThresholdSummary:
    """How soon runs reach a threshold, and how many do.

    The interval of the median goes from one order statistic to another, which holds for any
    distribution and also where runs never arrive; for 95 % it needs at least six runs. That of the
    share is Wilson's.

    Args:
        steps: what ``steps_to_threshold`` says of each run, shape (n_seeds,): infinity for a run
            that never reaches the threshold, NaN for one that failed.
        confidence: of the intervals.

    Raises:
        ValueError: for a confidence out of range.
    """
    check_confidence(confidence)
    all_steps = np.asarray(steps, dtype=np.float64)
    ordered = np.sort(all_steps[~np.isnan(all_steps)])
    n, n_missing = len(ordered), int(np.isnan(all_steps).sum())
    if n == 0:
        nothing = Estimate(np.nan, np.nan, np.nan, 0, n_missing)
        return ThresholdSummary(nothing, nothing)
    # How many runs to leave out at each end: one fewer than the smallest count likely enough.
    cut = int(stats.binom.ppf((1 - confidence) / 2, n, 0.5)) - 1
    low, high = (ordered[cut], ordered[n - 1 - cut]) if cut >= 0 else (np.nan, np.nan)
    n_reached = int(np.isfinite(ordered).sum())
    share = stats.binomtest(n_reached, n).proportion_ci(confidence, method="wilson")
    return ThresholdSummary(
        Estimate(float(np.median(ordered)), float(low), float(high), n, n_missing),
        Estimate(n_reached / n, float(share.low), float(share.high), n, n_missing),
    )


def _curve(steps: ArrayLike, values: ArrayLike) -> tuple[Floats, Floats]:
    x, y = np.asarray(steps, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or len(x) == 0 or y.shape[-1:] != x.shape:
        raise ValueError(f"a curve has steps of shape {x.shape} and values of shape {y.shape}")
    if (np.diff(x) < 0).any():
        raise ValueError(f"the steps of a curve fall after step {x[:-1][np.diff(x) < 0][0]:g}")
    return x, y
