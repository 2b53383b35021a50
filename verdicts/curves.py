"""Learning curves: areas, thresholds, speed, and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.means import FEWEST_SEEDS
from verdicts.rank_tests import apart_p_value, holm, interval_places
from verdicts.resampling import (
    N_RESAMPLES,
    Estimate,
    Floats,
    as_columns,
    check_confidence,
    drawn_in_pieces,
    enough_resamples,
    interval_tail,
    percentile_interval,
)

# The largest number of points that a figure can show.
_MOST_POINTS = 500


@dataclass(frozen=True)
class Band:
    """A curve with an interval at each point, each of shape (n_points,); NaN as in ``Estimate``."""

    point: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class ThresholdSummary:
    """How soon runs reach a threshold, where some never do."""

    #: Median steps to the threshold; runs that never reach it count as later than all others.
    #: Infinite where half of the runs or more never do.
    median: Estimate
    share_reached: Estimate  #: the share of runs that reach it


def area_under_curve(steps: ArrayLike, values: ArrayLike) -> Floats:
    """The mean height of a curve over its span, in the unit of its values.

    The trapezoidal rule, divided by the span. To compare curves that were evaluated at different
    points, put them ``on_grid`` first.

    Args:
        steps: shape (n_points,), non-decreasing.
        values: shape (n_points,) or (n_curves, n_points).

    Returns:
        Shape () or (n_curves,); the last value where the span is 0.

    Raises:
        ValueError: for decreasing steps, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    if x[-1] == x[0]:
        return y[..., -1]
    return np.asarray(np.trapezoid(y, x, axis=-1) / (x[-1] - x[0]))


def shared_grid(curves: Sequence[ArrayLike], n_points: int = _MOST_POINTS) -> Floats:
    """Steps at which several curves can be compared.

    Args:
        curves: the steps of each curve, non-decreasing.
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

    There is no interpolation: nothing is known between two evaluations.

    Args:
        steps: shape (n_points,), non-decreasing.
        values: shape (n_points,) or (n_curves, n_points).
        grid: shape (n_grid,).

    Returns:
        Shape (n_grid,) or (n_curves, n_grid); NaN before the first evaluation.

    Raises:
        ValueError: for decreasing steps, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    latest = np.searchsorted(x, np.asarray(grid, dtype=np.float64), side="right") - 1
    return np.where(latest < 0, np.nan, y[..., np.maximum(latest, 0)])


def curve_band(
    values: ArrayLike, *, seed: int, confidence: float = 0.95, n_resamples: int = 2000
) -> Band:
    """The mean over seeds at each point, with pointwise intervals.

    The intervals are those of ``estimate`` at each point.

    Args:
        values: shape (n_seeds, n_points), on a common grid. Non-finite values are left out at
            their point.
        seed: the seed of the resampling, which draws the same runs at every point.
        confidence: the confidence level of the intervals.
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
            columns = table if known.all() else table[there][:, places]
            band[:, places] = _resampled_means(columns, seed, confidence, n_resamples)
    return Band(*band)


def _resampled_means(columns: Floats, seed: int, confidence: float, n_resamples: int) -> Floats:
    """Mean, low and high end at each point, shape (3, n_points), of (n_seeds, n_points)."""
    n = len(columns)
    # Relative to the smallest value, so that the mean of equal values is exact.
    least = columns.min(axis=0)
    above = columns - least
    pieces = drawn_in_pieces((n,), enough_resamples(n_resamples, n), seed)
    resampled = np.concatenate([least + (counts @ above) / n for (counts,) in pieces])
    tail = interval_tail([np.arange(n, dtype=np.float64)], confidence)
    return np.array([least + above.mean(axis=0), *percentile_interval(resampled, tail)])


def steps_to_threshold(steps: ArrayLike, values: ArrayLike, threshold: float) -> float:
    """The step of the first evaluation whose value is at least the threshold.

    Args:
        steps: shape (n_points,), non-decreasing.
        values: shape (n_points,).
        threshold: in the unit of the values.

    Returns:
        The step; infinity if no evaluation reaches the threshold, NaN if there is no evaluation.

    Raises:
        ValueError: for decreasing steps, or shapes that do not fit.
    """
    x, y = _curve(steps, values)
    if np.isnan(y).all():
        return float("nan")
    reached = y >= threshold
    return float(x[reached.argmax()]) if reached.any() else float("inf")


def steps_to_stay(steps: ArrayLike, values: ArrayLike, threshold: float) -> float:
    """The step of the first evaluation from which on a curve never falls below a threshold.

    A fluctuating curve crosses it by luck long before; with many evaluations nearly every one does.

    Args:
        steps: shape (n_points,), non-decreasing.
        values: shape (n_points,).
        threshold: in the unit of the values.

    Returns:
        The step; infinity if the last evaluation is below the threshold, NaN without evaluations.

    Raises:
        ValueError: for decreasing steps, or shapes that do not fit.
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

    The interval of the median goes from one order statistic to another: it holds for any
    distribution, also if some runs never reach the threshold; for 95 % it needs at least six runs.
    The interval of the share is Wilson's.

    Args:
        steps: the result of ``steps_to_threshold`` for each run, shape (n_seeds,): infinity for a
            run that never reaches the threshold, NaN for a failed run.
        confidence: the confidence level of the intervals.

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
    # The runs to leave out at each end: one fewer than the quantile of the binomial distribution.
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


# Performance profiles: how an agent's scores are spread over environments and seeds.


def performance_profile(
    scores: ArrayLike,
    thresholds: ArrayLike,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> Band:
    """The share of runs that score higher than each threshold, averaged over environments.

    Args:
        scores: shape (n_seeds,), or (n_seeds, n_envs) on a scale that the environments share.
            Non-finite scores count as missing; NaN is returned if an environment has no others.
        thresholds: shape (n_thresholds,).
        seed: the seed of the resampling of runs, separately within each environment.
        confidence: the confidence level of the intervals, separately for each threshold.
        n_resamples: how many resamples they come from.

    Returns:
        The shares with their intervals, each of shape (n_thresholds,). Where all runs of every
        environment lie on the same side of a threshold the interval is the point.

    Raises:
        ValueError: for arguments out of range or of another shape.

    Source: Agarwal et al. (2021), section 4.2, "run-score distributions". The intervals are widened
    for few seeds, see ``interval_tail``.
    """
    columns, marks = as_columns(scores), np.asarray(thresholds, dtype=np.float64)
    strata = [column[np.isfinite(column)] for column in columns.T]
    if any(len(stratum) == 0 for stratum in strata):
        nothing = np.full(marks.shape, np.nan)
        return Band(nothing, nothing, nothing)
    above = [(stratum[:, None] > marks).astype(np.float64) for stratum in strata]
    n_resamples = enough_resamples(n_resamples, max(map(len, above)))
    resampled = np.concatenate(
        [
            sum((each @ rows / len(rows) for each, rows in zip(drawn, above, strict=True)), 0.0)
            for drawn in drawn_in_pieces(tuple(map(len, above)), n_resamples, seed)
        ]
    )
    tail = interval_tail(strata, confidence)
    low, high = percentile_interval(resampled / len(above), tail)
    return Band(np.mean([rows.mean(axis=0) for rows in above], axis=0), low, high)


# Which agent reaches a threshold sooner, from curves that were evaluated now and then.


@dataclass(frozen=True)
class SpeedComparison:
    """The ratio of the steps that two agents need to reach a threshold."""

    first: str  #: the name of the first agent, in the order of the mapping
    second: str  #: the name of the second agent
    #: Steps of the second divided by those of the first: the median over pairs of runs. The
    #: intervals of all pairs hold together, wherever between two evaluations runs arrived.
    ratio: Estimate
    #: The p-value of "one of the two is sooner", with Holm's correction over all pairs.
    adjusted_p_value: float
    sooner: str | None  #: the name of the agent that is shown to be sooner, or None


def compare_speed(
    steps: Mapping[str, ArrayLike], spacing: float, level: float = 0.05
) -> list[SpeedComparison]:
    """Compare every two agents, in the order of the mapping.

    Args:
        steps: by agent, shape (n_seeds,): the step of the evaluation at which a run first reached
            the threshold; infinity for a run that never did, NaN for a missing run.
        spacing: the most steps between two evaluations. A run may have reached the threshold at
            any step since the evaluation before: times within the same spacing count as equal.
        level: the share of studies in which any of the results may be wrong.
    """
    arrived = {
        name: np.ceil(found[~np.isnan(found)] / spacing) * spacing
        for name, found in ((name, np.asarray(each, np.float64)) for name, each in steps.items())
    }
    pairs = [
        pair
        for pair in combinations(arrived, 2)
        if min(len(arrived[name]) for name in pair) >= FEWEST_SEEDS
    ]
    p_values = holm([apart_p_value(*_ranked(arrived[a], arrived[b])) for a, b in pairs])
    found = []
    for (a, b), p_value in zip(pairs, p_values, strict=True):
        ratio = _ratio(arrived[a], arrived[b], spacing, level / len(pairs))
        sooner = None
        if p_value <= level:
            sooner = a if ratio.low > 1 else b if ratio.high < 1 else None
        found.append(SpeedComparison(a, b, ratio, float(p_value), sooner))
    return found


def _ranked(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Times as scores: sooner is higher, and a run that never reaches the threshold is lowest."""
    both = np.concatenate([first, second])
    last = both[np.isfinite(both)].max(initial=0.0) + 1
    return -np.minimum(first, last), -np.minimum(second, last)


def _ratio(first: Floats, second: Floats, spacing: float, level: float) -> Estimate:
    """The median ratio of times; its interval allows for any step since the evaluation before."""
    both = np.concatenate([first, second])
    # Runs that never reached the threshold would have taken longer than any that did.
    last = both[np.isfinite(both)].max(initial=0.0)
    # There are few evaluations, so many runs have the same time.
    (x, n_x), (y, n_y) = (np.unique(times, return_counts=True) for times in (first, second))
    x, weights = x[:, None], np.outer(n_x, n_y).ravel()

    def at(ratios: Floats, place: int) -> float:
        """The ratio at a place in the order of all pairs of runs."""
        order = np.argsort(ratios, axis=None)
        found = np.searchsorted(weights[order].cumsum(), place, side="right")
        return float(ratios.ravel()[order[found]])

    with np.errstate(divide="ignore", invalid="ignore"):
        middle = np.where(np.isinf(x) & np.isinf(y), 1.0, y / x)
        least = np.where(np.isinf(x), 0.0, (np.minimum(y, last + spacing) - spacing) / x)
        most = y / (np.minimum(x, last + spacing) - spacing)
    n, n_pairs = min(len(first), len(second)), len(first) * len(second)
    places = interval_places(len(first), len(second), level)
    low, high = np.nan, np.nan
    if places is not None:
        low = at(least, places[0])
        high = at(np.where(np.isnan(most), np.inf, most), places[1])
    median = (at(middle, (n_pairs - 1) // 2) + at(middle, n_pairs // 2)) / 2
    return Estimate(median, low, high, n)
