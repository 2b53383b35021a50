"""Learning curves: shared steps, bands, thresholds, and performance profiles.

A curve has steps of shape (n_points,), non-decreasing, and values of shape (n_points,), or
(n_curves, n_points) for several; others are refused with a ValueError.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rl_yardstick.verdicts.estimates import (
    UNBOUNDED,
    Bounds,
    Estimate,
    Floats,
    mean_over_runs,
    median_over_runs,
    share_interval,
)


@dataclass(frozen=True)
class Band:
    """A curve with an interval at each point, each of shape (n_points,)."""

    point: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class ThresholdSummary:
    """How soon runs reach a threshold, where some never do."""

    median: Estimate  #: of the steps; a run that never reaches it counts as later than all others
    share_reached: Estimate  #: the share of runs that reach it


def _curve(steps: ArrayLike, values: ArrayLike) -> tuple[Floats, Floats]:
    x, y = np.asarray(steps, np.float64), np.asarray(values, np.float64)
    if x.ndim != 1 or len(x) == 0 or y.shape[-1:] != x.shape:
        raise ValueError(f"a curve has steps of shape {x.shape} and values of shape {y.shape}")
    if (np.diff(x) < 0).any():
        raise ValueError(f"the steps of a curve fall after step {x[:-1][np.diff(x) < 0][0]:g}")
    return x, y


def shared_grid(curves: Sequence[ArrayLike], n_points: int = 500) -> Floats:
    """Steps at which curves with these steps can be compared.

    They are the points of all curves within the span that all of them cover; evenly spaced points
    of that span where those are more than ``n_points``.
    """
    steps = [np.asarray(curve, np.float64) for curve in curves]
    if not steps or min(map(len, steps)) == 0:
        raise ValueError("a curve without evaluations shares no steps with the others")
    start, end = max(curve[0] for curve in steps), min(curve[-1] for curve in steps)
    if start > end:
        raise ValueError(f"a curve ends at step {end:g} before another begins, at step {start:g}")
    points = np.unique(np.concatenate([*steps, [start, end]]))
    points = points[(start <= points) & (points <= end)]
    return points if len(points) <= n_points else np.linspace(start, end, n_points)


def on_grid(steps: ArrayLike, values: ArrayLike, grid: ArrayLike) -> Floats:
    """Curves at other steps, of shape (n_grid,): the latest value so far, NaN before the first."""
    x, y = _curve(steps, values)
    latest = np.searchsorted(x, np.asarray(grid, np.float64), side="right") - 1
    return np.where(latest < 0, np.nan, y[..., np.maximum(latest, 0)])


def curve_band(values: ArrayLike, bounds: Bounds = UNBOUNDED) -> Band:
    """The mean over runs at each point, with the intervals of ``mean_over_runs``.

    ``values`` are of shape (n_runs, n_points); non-finite ones are left out at their point.
    """
    points = [mean_over_runs(column, bounds) for column in np.transpose(values)]
    return Band(*np.reshape([(each.point, each.low, each.high) for each in points], (-1, 3)).T)


def steps_to_threshold(
    steps: ArrayLike, values: ArrayLike, threshold: float, *, to_stay: bool = False
) -> float:
    """The step of the first evaluation that reaches a threshold, or from which all later ones do.

    ``to_stay`` chooses the latter: a fluctuating curve crosses a threshold by luck long before.
    Infinity if it is never reached, NaN without evaluations.
    """
    x, y = _curve(steps, values)
    x, y = x[~np.isnan(y)], y[~np.isnan(y)]
    reached = y >= threshold
    if to_stay:
        reached = np.logical_and.accumulate(reached[::-1])[::-1]
    return float(x[reached.argmax()]) if reached.any() else np.inf if len(y) else np.nan


def summarise_steps(steps: ArrayLike) -> ThresholdSummary:
    """How soon runs reach a threshold, and how many do, from ``steps_to_threshold`` of each."""
    median = median_over_runs(steps)
    if not median.n:
        return ThresholdSummary(median, median)
    n_reached = int(np.isfinite(np.asarray(steps, np.float64)).sum())
    low, high = share_interval(n_reached, median.n)
    share = Estimate(n_reached / median.n, low, high, median.n, median.n_missing)
    return ThresholdSummary(median, share)


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Floats:
    """The share of runs that score higher than each threshold, averaged over environments.

    ``scores`` are of shape (n_runs, n_envs), on a scale that environments share; NaN is missing.
    Source: Agarwal et al. (2021), section 4.2, "run-score distributions".
    """
    table, marks = np.asarray(scores, np.float64), np.asarray(thresholds, np.float64)
    above = (table[..., None] > marks).sum(axis=0)
    shares: Floats = (above / np.isfinite(table).sum(axis=0)[:, None]).mean(axis=0)
    return shares
