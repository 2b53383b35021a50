"""Which agent is sooner, and how many runs failed: worked by hand and in simulation."""

import numpy as np
import pytest
from scipy import stats

from verdicts import (
    compare_speed,
    count_failures,
    fail_more_often,
    failure_threshold,
    steps_to_stay,
)

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
    assert fail_more_often({"x": count(0, 0), "y": count(4, 4)}) == []
