"""Estimates and their intervals: worked by hand, resampled the plain way, coverage simulated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pipeline.evaluation.yardstick import Yardstick
from verdicts import (
    estimate,
    optimum_score,
    performance_profile,
    summarise,
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
