"""Figures over runs with their intervals, and learning curves: by hand, and against SciPy."""

import math

import numpy as np
import pytest
from scipy import stats

from rl_yardstick import verdicts
from rl_yardstick.verdicts.estimates import median_over_runs, share_interval

INF, NAN = math.inf, math.nan


def ends(found):
    return found.low, found.high


def test_a_mean_has_students_interval_cut_at_what_is_possible():
    runs = np.array([3.0, 5, 4, 8, 6])
    found = verdicts.mean_over_runs([*runs, NAN])
    assert (found.point, found.n, found.n_missing) == (pytest.approx(5.2), 5, 1)
    low, high = stats.t.interval(0.95, 4, runs.mean(), stats.sem(runs))
    assert ends(found) == pytest.approx((low, high))
    assert ends(verdicts.mean_over_runs(runs, (4, 6))) == (4, 6)
    # Bounds that the runs contradict do not move the mean out of its interval.
    assert ends(verdicts.mean_over_runs(runs, (0, 5))) == pytest.approx((low, 5.2))


@pytest.mark.parametrize(
    ("runs", "point", "interval"),
    [
        ([500.0] * 10, 500, (500, 500)),
        ([0.1] * 7, 0.1, (0.1, 0.1)),
        ([3.0, 1.0, 2.0, 2.0], 2, (1, 3)),  # below five runs their range
        ([4.0], 4, (4, 4)),
        ([], NAN, (NAN, NAN)),
        ([NAN, INF], NAN, (NAN, NAN)),
    ],
)
def test_equal_few_and_no_runs(runs, point, interval):
    found = verdicts.mean_over_runs(runs)
    assert [found.point, *ends(found)] == pytest.approx([point, *interval], abs=0, nan_ok=True)
    assert found.is_range == (len(runs) < 5)
    assert found.n_missing == (len(runs) if math.isnan(point) else 0)


@pytest.mark.parametrize("n", [6, 9, 16, 30])
def test_the_interval_of_the_median_covers_and_is_the_shortest_that_does(n):
    found = median_over_runs(np.arange(n))
    cut = int(found.low)
    assert (found.point, found.high) == ((n - 1) / 2, n - 1 - cut)
    covered = [1 - 2 * stats.binom.cdf(outside, n, 0.5) for outside in (cut, cut + 1)]
    assert covered[0] >= 0.95 > covered[1]
    assert ends(median_over_runs([5, 1, 2, 4, 3])) == (1, 5)  # where no interval covers


def test_the_middle_half():
    # Two of eight are left out on each side, one of seven.
    assert verdicts.summarise([0.0, 1, 2, 3, 5, 6, 7, 100]).iqm == 4
    assert verdicts.summarise([0.0, 1, 2, 3, 4, 5, 100, NAN]).iqm == 3
    assert verdicts.summarise([0.5] * 4).iqm == 0.5


def test_a_share_has_the_interval_of_clopper_and_pearson():
    for count, n in ((0, 10), (3, 10), (10, 10), (1, 200)):
        exact = stats.binomtest(count, n).proportion_ci(0.95, method="exact")
        assert share_interval(count, n) == pytest.approx((exact.low, exact.high))


@pytest.mark.parametrize(
    ("values", "threshold", "first", "to_stay"),
    [
        ([0, 5, 3, 9], 5, 20, 40),  # reached, lost again, and reached
        ([0, 5, 3, 9], 5.1, 40, 40),
        ([7, 0, 0, 0], 5, 10, INF),
        ([5, 6, 7, 8], 5, 10, 10),
        ([0, 1, 2, 3], 5, INF, INF),
        ([NAN, NAN, 6, 0], 5, 30, INF),
        ([0, NAN, 6, 7], 5, 30, 30),
        ([NAN] * 4, 5, NAN, NAN),
    ],
)
def test_steps_to_a_threshold(values, threshold, first, to_stay):
    for stays, expected in ((False, first), (True, to_stay)):
        found = verdicts.steps_to_threshold([10, 20, 30, 40], values, threshold, to_stay=stays)
        assert found == pytest.approx(expected, nan_ok=True)


def test_curves_that_are_none_are_refused():
    with pytest.raises(ValueError, match="fall after step 20"):
        verdicts.on_grid([10, 20, 15], [0, 0, 0], [0])
    with pytest.raises(ValueError, match=r"steps of shape \(2,\) and values of shape \(3,\)"):
        verdicts.on_grid([0, 1], [0, 0, 0], [0])
    with pytest.raises(ValueError, match="shape"):
        verdicts.steps_to_threshold([], [], 1)


def test_the_shared_grid_is_where_all_curves_are():
    assert verdicts.shared_grid([[0, 10, 20, 30], [5, 10, 25]]).tolist() == [5, 10, 20, 25]
    long = np.arange(1001)
    assert verdicts.shared_grid([long, long[:901]], n_points=4).tolist() == [0, 300, 600, 900]
    with pytest.raises(ValueError, match="ends at step 3 before another begins, at step 4"):
        verdicts.shared_grid([[1, 3], [4, 5]])
    with pytest.raises(ValueError, match="without evaluations"):
        verdicts.shared_grid([[1, 3], []])


def test_a_curve_on_a_grid_holds_its_latest_value():
    found = verdicts.on_grid([10, 20], [1, 2], [0, 10, 14.9, 20, 99]).tolist()
    assert found == pytest.approx([NAN, 1, 1, 2, 2], nan_ok=True)
    # Two evaluations at one step: the later one.
    assert verdicts.on_grid([10, 10, 20], [1, 5, 2], [10]).tolist() == [5]
    assert verdicts.on_grid([10, 20], [[1, 2], [3, 4]], [15, 25]).tolist() == [[1, 2], [3, 4]]


def test_a_band_is_the_mean_over_runs_at_each_point():
    values = np.random.default_rng(0).normal(size=(6, 5))
    values[0, 1] = NAN
    values[:, 2] = 0.1  # equal values keep theirs to the last bit
    values[:3, 3] = NAN  # few runs
    values[:, 4] = INF
    band = verdicts.curve_band(values, (-1, 0.5))
    for place, column in enumerate(values.T):
        one = verdicts.mean_over_runs(column, (-1, 0.5))
        found = [band.point[place], band.low[place], band.high[place]]
        assert found == pytest.approx([one.point, *ends(one)], abs=1e-12, nan_ok=True)
    assert (band.low[2], band.point[2], band.high[2]) == (0.1, 0.1, 0.1)


def test_steps_over_runs_worked_by_hand():
    summary = verdicts.summarise_steps([300, 100, INF, 200, INF, 500, 400, NAN])
    # Sorted 100 200 300 400 500 inf inf: P(Bin(7, 1/2) = 0) = 1/128, so the extremes, at 98.4 %.
    assert (summary.median.point, *ends(summary.median)) == (400, 100, INF)
    assert (summary.median.n, summary.median.n_missing) == (7, 1)
    assert summary.share_reached.point == pytest.approx(5 / 7)
    assert ends(summary.share_reached) == pytest.approx(share_interval(5, 7))
    assert verdicts.summarise_steps([INF, 5, INF, 7, INF]).median.point == INF
    assert verdicts.summarise_steps([INF] * 4).share_reached.point == 0
    assert np.isnan(verdicts.summarise_steps([NAN]).share_reached.point)


def test_a_profile_worked_by_hand():
    profile = verdicts.performance_profile([[0.0, 1.0], [0.5, 1.0], [1.0, NAN]], [-1, 0, 0.5, 1])
    # Strictly above: of the three and of the two, averaged over the two environments.
    assert profile.tolist() == pytest.approx([1, 5 / 6, 4 / 6, 0])
