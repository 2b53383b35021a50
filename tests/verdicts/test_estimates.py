"""Figures of one agent: estimates, learning curves, speed and failures, by hand and simulated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pipeline.evaluation.yardstick import Yardstick
from verdicts import (
    area_under_curve,
    compare_speed,
    count_failures,
    curve_band,
    estimate,
    fail_more_often,
    failure_threshold,
    on_grid,
    optimum_score,
    performance_profile,
    shared_grid,
    steps_to_stay,
    steps_to_threshold,
    summarise,
    summarise_steps,
)
from verdicts.resampling import enough_resamples, interval_tail

STATISTICS = ("mean", "median", "iqm")
PLAIN = {"mean": np.mean, "median": np.median, "iqm": lambda x: stats.trim_mean(x, 0.25)}

NUMBERS = st.floats(-1e3, 1e3).map(lambda x: round(x, 3))


def points(summary):
    return [getattr(summary, name).point for name in STATISTICS]


# --- points --------------------------------------------------------------------------------------


def test_statistics_worked_by_hand():
    # Sorted 0 1 2 3 4 5 6 100: the middle half is 2 3 4 5.
    summary = summarise([100, 0, 1, 6, 2, 5, 3, 4], seed=0)
    assert points(summary) == [121 / 8, 3.5, 3.5]
    # Five: one is left out at either end.
    assert points(summarise([0, 10, 1, 2, 30], seed=0)) == pytest.approx([8.6, 2, 13 / 3])


@given(st.lists(NUMBERS, min_size=1, max_size=30))
def test_statistics_equal_the_plain_ones(scores):
    summary = summarise(scores, seed=0, n_resamples=10)
    plain = [PLAIN[name](scores) for name in STATISTICS]
    assert points(summary) == pytest.approx(plain, abs=1e-9)


def test_environments_weigh_the_same_where_runs_are_missing():
    scores = [[1, 10], [3, np.nan], [np.inf, 30], [8, np.nan]]
    mean = estimate(scores, "mean", seed=0)
    assert mean.point == pytest.approx((4 + 20) / 2)
    assert (mean.n, mean.n_missing) == (5, 3)
    # Weights 5/6, 5/6, 5/6, 5/4, 5/4; the middle one of five holds 3, 8 and 10 partly:
    # 5/3 lie at or below 3, 5/2 at or below 8, 15/4 at or below 10; the cut goes from 2 to 3.
    median = estimate(scores, "median", seed=0)
    assert median.point == pytest.approx(0.5 * 8 + 0.5 * 10)


# --- intervals -----------------------------------------------------------------------------------


def test_the_interval_for_one_environment_is_the_expanded_percentile_interval():
    scores = np.random.default_rng(3).exponential(size=9)
    drawn = scores[np.random.default_rng(11).integers(9, size=(2000, 9))]
    tail = stats.norm.cdf(-np.sqrt(9 / 8) * stats.t.ppf(0.975, 8))
    for name in STATISTICS:
        resampled = [PLAIN[name](sample) for sample in drawn]
        found = estimate(scores, name, seed=11, n_resamples=2000)
        assert [found.low, found.high] == pytest.approx(np.quantile(resampled, [tail, 1 - tail]))


def test_seeds_are_resampled_within_each_environment():
    scores = np.random.default_rng(3).normal([0, 5, 50], [1, 2, 3], size=(6, 3))
    rng = np.random.default_rng(11)
    drawn = [column[rng.integers(6, size=(2000, 6))] for column in scores.T]
    tail = interval_tail(list(scores.T), 0.95)
    for name in STATISTICS:
        resampled = [PLAIN[name](sample) for sample in np.hstack(drawn)]
        found = estimate(scores, name, seed=11, n_resamples=2000)
        assert found == getattr(summarise(scores, seed=11, n_resamples=2000), name)
        assert found.point == pytest.approx(PLAIN[name](scores.ravel()))
        assert [found.low, found.high] == pytest.approx(np.quantile(resampled, [tail, 1 - tail]))


def test_the_tail_of_several_environments_has_the_degrees_of_freedom_of_welch():
    strata = [np.array([0.0, 2, 4]), np.array([0.0, 1, 2, 3])]
    u = [4 / 3, (5 / 3) / 4]
    degrees = sum(u) ** 2 / (u[0] ** 2 / 2 + u[1] ** 2 / 3)
    widening = np.sqrt(sum(u) / (u[0] * 2 / 3 + u[1] * 3 / 4))
    expected = stats.norm.cdf(-widening * stats.t.ppf(0.95, degrees))
    assert interval_tail(strata, 0.9) == pytest.approx(expected)
    # Two alike add up their degrees of freedom.
    alike = stats.norm.cdf(-np.sqrt(3 / 2) * stats.t.ppf(0.975, 4))
    assert interval_tail([strata[0], strata[0]], 0.95) == pytest.approx(alike)


def test_many_seeds_need_fewer_resamples():
    found = [enough_resamples(10_000, n) for n in (5, 200, 500, 2000, 100_000)]
    assert found == [10_000, 10_000, 4000, 1000, 1000]
    assert enough_resamples(50, 2000) == 50
    many = np.random.default_rng(0).normal(size=2000)
    mean = estimate(many, "mean", seed=0)
    assert mean == estimate(many, "mean", seed=0, n_resamples=1000)
    half = stats.norm.isf(0.025) * stats.sem(many)
    assert (mean.high - mean.low) / 2 == pytest.approx(half, rel=0.1)


def test_equal_scores_have_the_point_as_interval():
    summary = summarise([0.1] * 7, seed=0)
    for name in STATISTICS:
        found = getattr(summary, name)
        assert (found.point, found.low, found.high) == (0.1, 0.1, 0.1)
        assert found.has_interval


@pytest.mark.parametrize("scores", [[4.0], [4.0, np.nan], [[4.0, 1.0], [np.nan, 2.0]]])
@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_single_seed_has_no_interval(scores, statistic):
    found = estimate(scores, statistic, seed=0)
    assert np.isfinite(found.point)
    assert np.isnan([found.low, found.high]).all()
    assert not found.has_interval


@pytest.mark.parametrize("scores", [[np.nan], [np.nan, np.inf], [[1.0, np.nan], [2.0, np.nan]]])
def test_without_a_score_there_is_no_figure(scores):
    found = estimate(scores, "iqm", seed=0)
    assert np.isnan([found.point, found.low, found.high]).all()
    assert found.n_missing == np.sum(~np.isfinite(scores))


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"shape \(1, 1, 1\), they must have"):
        summarise([[[1.0]]], seed=0)
    with pytest.raises(ValueError, match=r"shape \(0,\)"):
        summarise([], seed=0)
    for confidence in (-0.1, 0, 1, 95, float("nan")):
        with pytest.raises(ValueError, match="it must lie between 0 and 1, as 0"):
            summarise([1.0, 2.0], seed=0, confidence=confidence)


# --- coverage ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("statistic", "n"), [("mean", 5), ("median", 10), ("iqm", 5), ("iqm", 30)])
def test_intervals_over_normal_scores_cover(statistic, n):
    """Of 600 intervals; the standard error is 0.009 at 0.95."""
    rng = np.random.default_rng(7)
    found = [
        estimate(rng.normal(3, 2, size=n), statistic, seed=trial, n_resamples=1000)
        for trial in range(600)
    ]
    # Percentiles as they are cover 83 % with 5 seeds and 90 % with 10.
    least = 0.89 if n == 5 else 0.92
    assert least <= np.mean([one.low <= 3 <= one.high for one in found]) <= 0.985


# --- scores and profiles -------------------------------------------------------------------------


def test_scores_are_those_of_the_yardstick():
    returns = np.array([[79.0, -1000.0], [-460.5, 80.0]])
    yardstick = Yardstick(optimum=79.0, baseline=-1000.0)
    scores = optimum_score(returns, 79.0, -1000.0)
    assert scores[0].tolist() == [1, 0]
    assert scores[1, 0] == 0.5
    for index, value in np.ndenumerate(returns):
        assert scores[index] == yardstick.score(value)


def test_scores_where_the_blind_policy_is_optimal():
    assert optimum_score([1.0, 0.5, np.nan], 1.0, 1.0).tolist() == pytest.approx(
        [1, 0, np.nan], nan_ok=True
    )
    assert np.isnan(optimum_score(np.nan, 1.0, 0.0))


def test_a_profile_worked_by_hand():
    scores = [[0.0, 1.0], [0.5, 1.0], [1.0, np.nan]]
    profile = performance_profile(scores, [-1, 0, 0.5, 1], seed=0)
    # Strictly above: of the three and of the two, averaged over the two environments.
    assert profile.point.tolist() == pytest.approx([1, 5 / 6, 4 / 6, 0])
    assert (profile.low <= profile.point).all()
    assert (profile.point <= profile.high).all()
    assert (profile.low[0], profile.high[0], profile.low[3], profile.high[3]) == (1, 1, 0, 0)
    # The second environment adds a half, the first a share of three draws.
    assert {round(6 * x, 6) for x in (profile.low[2], profile.high[2])} <= {3, 4, 5, 6}


def test_a_profile_has_no_band_over_one_seed_and_no_share_over_none():
    single = performance_profile([[0.2, 0.8]], [0.5], seed=0)
    assert single.point.tolist() == [0.5]
    assert np.isnan([single.low, single.high]).all()
    assert np.isnan(performance_profile([[0.2, np.nan]], [0.5], seed=0).point).all()


# === learning curves ==============================================================================


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


# === speed and failures ===========================================================================


NEVER = np.inf


def test_the_ratio_of_steps_worked_by_hand():
    # Whatever happened between evaluations 100 steps apart: at least (1000 - 100) / 300 times.
    steps = {"quick": [200, 300] * 3, "slow": [1000, 1200] * 3}
    (pair,) = compare_speed(steps, 100)
    assert (pair.first, pair.second, pair.sooner) == ("quick", "slow", "quick")
    assert pair.ratio.point == np.median([1000 / 200, 1000 / 300, 1200 / 200, 1200 / 300])
    assert (pair.ratio.low, pair.ratio.high) == (pytest.approx(3.0), pytest.approx(12.0))
    (turned,) = compare_speed(dict(reversed(steps.items())), 100)
    assert turned.sooner == "quick"
    assert turned.ratio.high < 1


@given(*[st.lists(st.sampled_from([100.0, 200, 300, 500, NEVER]), min_size=5, max_size=9)] * 2)
def test_the_ratio_is_that_of_all_pairs_and_turns_round(first, second):
    (one,) = compare_speed({"x": first, "y": second}, 100)
    (other,) = compare_speed({"y": second, "x": first}, 100)
    ratios = [1.0 if x == y == NEVER else y / x for x in first for y in second]
    middle = np.sort(ratios)[[(len(ratios) - 1) // 2, len(ratios) // 2]]
    assert one.ratio.point == middle.sum() / 2
    with np.errstate(divide="ignore"):
        turned = 1 / np.array([other.ratio.high, other.ratio.low])
    assert [one.ratio.low, one.ratio.high] == pytest.approx(turned)
    assert (one.sooner, one.adjusted_p_value) == (other.sooner, other.adjusted_p_value)


def test_nothing_is_said_below_the_grid_of_the_evaluations():
    steps = {"quick": [100.0] * 10, "slow": [200.0] * 10}
    (apart,) = compare_speed(steps, 100)
    # One may have arrived at step 100 and the other at 101.
    assert apart.adjusted_p_value < 0.05
    assert apart.ratio.low == 1
    assert apart.sooner is None
    (finer,) = compare_speed(steps, 20)
    assert finer.sooner == "quick"
    (same,) = compare_speed({"quick": [120.0] * 10, "slow": [180.0] * 10}, 100)
    assert same.adjusted_p_value == 1


def test_runs_that_never_arrive_are_later_than_all_others():
    steps = {"quick": [200.0] * 8, "never": [NEVER] * 7 + [800]}
    (pair,) = compare_speed(steps, 100)
    assert pair.sooner == "quick"
    assert pair.ratio.point == pair.ratio.high == NEVER
    assert pair.ratio.low == pytest.approx(800 / 200)
    (neither,) = compare_speed({"x": [NEVER] * 8, "y": [NEVER] * 8}, 100)
    assert neither.sooner is None
    assert neither.adjusted_p_value == 1


def test_few_seeds_say_nothing_of_speed():
    assert compare_speed({"x": [100] * 4 + [np.nan], "y": [900] * 5}, 10) == []
    (pair,) = compare_speed({"x": [100] * 5, "y": [900] * 5}, 10, 0.001)
    assert pair.sooner is None
    assert not pair.ratio.has_interval


def test_staying_is_told_from_a_first_crossing():
    steps = [10, 20, 30, 40, 50]
    assert steps_to_stay(steps, [0, 1, 0, 1, 1], 1) == 40
    assert steps_to_stay(steps, [1, 1, 1, 1, 1], 1) == 10
    assert steps_to_stay(steps, [1, 1, 1, 1, 0.745], 0.95) == NEVER
    assert steps_to_stay(steps, [0, np.nan, 1, np.nan, 1], 1) == 30
    assert np.isnan(steps_to_stay(steps, [np.nan] * 5, 1))


def test_failures_have_a_bound_of_clopper_and_pearson():
    none = count_failures([1.0] * 10, 0.5)
    # The bound p solves (1 - p)**10 = 0.05.
    assert (none.n_failed, none.n, none.most) == (0, 10, pytest.approx(1 - 0.05**0.1))
    two = count_failures([0.0, 0.2, 0.5, 1, np.nan], 0.5, level=0.025)
    exact = stats.binomtest(2, 4).proportion_ci(0.95, method="exact").high
    assert (two.n_failed, two.n, two.most) == (2, 4, pytest.approx(exact))
    assert count_failures([0.0], 0.5).most == 1


def test_what_counts_as_a_failure():
    assert failure_threshold(0.2, 1.0) == pytest.approx(0.6)
    # Where nobody is better than baseline nothing sets a failure apart.
    assert np.isnan(failure_threshold(0.2, 0.2))
    assert count_failures([0, 1], failure_threshold(1, 0)).n_failed == 0


def test_failing_more_often_is_fishers_test():
    def count(n_failed, n):
        return count_failures([0.0] * n_failed + [1.0] * (n - n_failed), 0.5)

    # Six of ten against none: 2 * C(10, 6) / C(20, 6) = 0.011; five: 0.033.
    assert fail_more_often({"x": count(0, 10), "y": count(6, 10)}) == [("y", "x")]
    assert fail_more_often({"y": count(5, 10), "x": count(0, 10)}) == [("y", "x")]
    assert fail_more_often({"y": count(4, 10), "x": count(0, 10)}) == []
    # Of three pairs the surest has to be three times as sure.
    assert fail_more_often({"y": count(5, 10), "x": count(0, 10), "z": count(2, 10)}) == []
    # Who has no run makes no pair.
    assert fail_more_often({"y": count(5, 10), "x": count(0, 10), "z": count(0, 0)}) == [("y", "x")]
