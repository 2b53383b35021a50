"""Learning curves: areas, thresholds and common grids, worked by hand."""

import numpy as np
import pytest
from scipy import stats

from verdicts import (
    area_under_curve,
    curve_band,
    estimate,
    on_grid,
    shared_grid,
    steps_to_threshold,
    summarise_steps,
)

INF, NAN = np.inf, np.nan

# --- one curve -----------------------------------------------------------------------------------


def test_areas_worked_by_hand():
    # Trapezoids 10 x 1 and 30 x 3 over a span of 40.
    assert area_under_curve([0, 10, 40], [0, 2, 4]) == 2.5
    assert area_under_curve([10, 20], [[0, 2], [5, 5]]).tolist() == [1, 5]
    assert area_under_curve([7], [3]) == 3
    assert np.isnan(area_under_curve([0, 1, 2], [0, NAN, 1]))


@pytest.mark.parametrize(
    ("values", "threshold", "steps"),
    [
        ([0, 5, 3, 9], 5, 20),  # reached, lost again, and reached: the first counts
        ([0, 5, 3, 9], 5.1, 40),
        ([7, 0, 0, 0], 5, 10),
        ([0, 1, 2, 3], 5, INF),
        ([NAN, NAN, 6, 0], 5, 30),
        ([NAN] * 4, 5, NAN),
    ],
)
def test_steps_to_a_threshold(values, threshold, steps):
    found = steps_to_threshold([10, 20, 30, 40], values, threshold)
    assert found == pytest.approx(steps, nan_ok=True)


def test_curves_that_are_none_are_refused():
    with pytest.raises(ValueError, match="fall after step 20"):
        area_under_curve([10, 20, 15], [0, 0, 0])
    with pytest.raises(ValueError, match=r"steps of shape \(2,\) and values of shape \(3,\)"):
        on_grid([0, 1], [0, 0, 0], [0])
    with pytest.raises(ValueError, match="shape"):
        steps_to_threshold([], [], 1)


# --- several curves ------------------------------------------------------------------------------


def test_the_shared_grid_is_where_all_curves_are():
    assert shared_grid([[0, 10, 20, 30], [5, 10, 25]]).tolist() == [5, 10, 20, 25]
    assert shared_grid([[0, 10], [0, 10]]).tolist() == [0, 10]
    long = np.arange(1001)
    assert shared_grid([long, long[:901]], n_points=4).tolist() == [0, 300, 600, 900]
    with pytest.raises(ValueError, match="ends at step 3 and another begins at step 4"):
        shared_grid([[1, 3], [4, 5]])
    with pytest.raises(ValueError, match="without evaluations"):
        shared_grid([[1, 3], []])


def test_a_curve_on_a_grid_holds_its_latest_value():
    grid = [0, 10, 14.9, 20, 99]
    assert on_grid([10, 20], [1, 2], grid).tolist() == pytest.approx([NAN, 1, 1, 2, 2], nan_ok=True)
    # Two evaluations at one step: the later one.
    assert on_grid([10, 10, 20], [1, 5, 2], [10]).tolist() == [5]
    both = on_grid([10, 20], [[1, 2], [3, 4]], [15, 25])
    assert both.tolist() == [[1, 2], [3, 4]]


def test_a_band_is_the_estimate_at_each_point():
    values = np.random.default_rng(0).normal(size=(6, 3))
    values[0, 1] = NAN
    values[:, 2] = 0.1  # equal values keep theirs to the last bit
    band = curve_band(values, seed=2)
    for place, column in enumerate(values.T):
        one = estimate(column, "mean", seed=2, n_resamples=2000)
        found = [band.point[place], band.low[place], band.high[place]]
        assert found == pytest.approx([one.point, one.low, one.high], abs=1e-12)
    assert (band.low[2], band.point[2], band.high[2]) == (0.1, 0.1, 0.1)


def test_a_band_has_nothing_where_no_run_has():
    band = curve_band([[1.0, NAN], [3.0, NAN]], seed=0)
    assert (band.point[0], np.isnan(band.point[1]), np.isnan(band.low[1])) == (2, True, True)
    alone = curve_band([[1.0, 2.0]], seed=0)
    assert alone.point.tolist() == [1, 2]
    assert np.isnan(alone.low).all()


# --- censored steps ------------------------------------------------------------------------------


def test_steps_over_seeds_worked_by_hand():
    steps = [300, 100, INF, 200, INF, 500, 400, NAN]
    summary = summarise_steps(steps)
    # Sorted 100 200 300 400 500 inf inf: P(Bin(7, 1/2) = 0) = 1/128, so the extremes, at 98.4 %.
    assert (summary.median.point, summary.median.low, summary.median.high) == (400, 100, INF)
    assert (summary.median.n, summary.median.n_missing) == (7, 1)
    assert summary.share_reached.point == pytest.approx(5 / 7)
    # At 85 %, P(Bin <= 1) = 8/128 lies below 7.5 % on each side: the second and the sixth.
    assert summarise_steps(steps, confidence=0.85).median.low == 200


def test_the_share_that_reaches_has_wilsons_interval():
    share = summarise_steps([1.0] * 8 + [INF] * 2).share_reached
    z, n, p = stats.norm.ppf(0.975), 10, 0.8
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert [share.low, share.high] == pytest.approx([middle - half, middle + half])


def test_medians_that_are_never_reached():
    assert summarise_steps([INF, 5, INF, 7, INF]).median.point == INF
    assert summarise_steps([5, 7, INF, INF]).median.point == INF
    assert summarise_steps([INF] * 4).share_reached.point == 0
    assert summarise_steps([INF] * 8).median.low == INF


def test_five_seeds_cannot_give_an_interval_for_a_median():
    few, enough = summarise_steps([1, 2, 3, 4, 5]).median, summarise_steps(range(6)).median
    assert few.point == 3
    assert not few.has_interval
    assert (enough.low, enough.high) == (0, 5)
    nothing = summarise_steps([NAN, NAN])
    assert np.isnan([nothing.median.point, nothing.share_reached.point]).all()
    assert nothing.median.n_missing == 2


@pytest.mark.parametrize("n", [6, 9, 16, 30])
def test_the_interval_of_the_median_covers_and_is_the_shortest_that_does(n):
    ordered = np.arange(n)
    cut = int(summarise_steps(ordered).median.low)
    assert summarise_steps(ordered).median.high == n - 1 - cut
    covered = [1 - 2 * stats.binom.cdf(outside, n, 0.5) for outside in (cut, cut + 1)]
    assert covered[0] >= 0.95 > covered[1]
