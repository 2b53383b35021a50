"""Rank-sum tests against SciPy's, against counting by hand, and in simulation."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from verdicts import (
    ahead_p_value,
    apart_p_value,
    equivalent_p_value,
    judge_pairs,
    level_of_look,
)
from verdicts.rank_tests import interval_places, rank_sum_p_value, share_p_value, wins_of

SCORES = st.lists(st.integers(0, 3), min_size=2, max_size=5)


@given(SCORES, SCORES)
def test_the_rank_sum_test_counts_every_split(first, second):
    pooled = stats.rankdata([*first, *second])
    sums = [sum(pooled[list(rows)]) for rows in combinations(range(len(pooled)), len(first))]
    expected = np.mean(np.array(sums) >= pooled[: len(first)].sum())
    found = rank_sum_p_value(np.array(first, float), np.array(second, float))
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(("n", "m"), [(5, 5), (4, 9), (20, 20)])
def test_without_ties_it_is_scipys(n, m):
    rng = np.random.default_rng(n)
    first, second = rng.normal(size=n) + 0.5, rng.normal(size=m)
    expected = stats.mannwhitneyu(first, second, alternative="greater", method="exact").pvalue
    assert rank_sum_p_value(first, second) == pytest.approx(expected)


def test_many_scores_with_ties_are_tested_as_counted_ones():
    # Fisher's exact test is the rank-sum test of scores that are 0 or 1.
    first, second = np.repeat([0.0, 1.0], [2, 28]), np.repeat([0.0, 1.0], [10, 20])
    exact = stats.fisher_exact([[28, 2], [20, 10]], alternative="greater").pvalue
    assert rank_sum_p_value(first, second) == pytest.approx(exact, rel=0.2)
    assert rank_sum_p_value(np.ones(40), np.ones(40)) == 1


def test_scores_that_differ_in_the_last_bits_are_equal():
    assert wins_of(np.array([0.3]), np.array([0.1 + 0.2])).item() == 0.5
    assert rank_sum_p_value(np.full(9, 0.1 + 0.2), np.full(9, 0.3)) == 1


def test_a_share_of_won_pairs_is_no_surer_than_a_sign_test():
    steady, erratic = np.zeros(7), np.array([1.0, 1, 1, 1, 1, 1, -1])
    # Six of seven: (7 + 1) / 2**7.
    assert share_p_value(erratic, steady) == pytest.approx(8 / 128)
    assert share_p_value(np.ones(7), steady) == pytest.approx(1 / 128)
    assert share_p_value(steady, erratic) == 1
    # Nearly always is no surer than always.
    nearly = np.array([0.0, 1, 2, 3, 4, 5.5]), np.array([5.0, 6, 7, 8, 9, 10])
    assert share_p_value(*reversed(nearly)) == 1 / 2**6
    # The rank-sum test alone would be surer.
    assert 2 * rank_sum_p_value(erratic, steady) < 0.05 < apart_p_value(erratic, steady)


def test_the_larger_of_two_p_values_counts():
    rng = np.random.default_rng(0)
    first, second = rng.normal([[0.8], [0]], 1, size=(2, 12))
    both = rank_sum_p_value(first, second), share_p_value(first, second)
    assert ahead_p_value(first, second) == max(both)
    assert apart_p_value(first, second) == apart_p_value(second, first) == 2 * max(both)
    sides = ahead_p_value(first + 2, second), ahead_p_value(second + 2, first)
    assert equivalent_p_value(first, second, 2.0) == max(sides)
    assert np.isnan(ahead_p_value(first, second[:0]))


def test_the_interval_of_a_median_of_differences_worked_by_hand():
    # Two-sided 0.05 leaves out two of the 25 on each side: 2 (1 + 1) / 252, (1 + 1 + 2) is 0.032.
    assert interval_places(5, 5, 0.05) == (2, 22)
    assert interval_places(4, 4, 0.05) is None


@pytest.mark.parametrize("n", [8, 30])
def test_the_interval_of_a_median_of_differences_covers(n):
    rng = np.random.default_rng(n)
    pairs = rng.exponential(size=(2000, 2, n))
    apart = np.sort([np.subtract.outer(*pair).ravel() for pair in pairs])
    low, high = apart[:, interval_places(n, n, 0.05)].T
    # Standard error 0.5 %; steps of the exact test make it a little cautious.
    assert 0.025 < ((low > 0) | (high < 0)).mean() < 0.065


def test_looks_spend_no_more_than_there_is():
    spent = [level_of_look(0.05, look) for look in range(1, 1000)]
    assert 0.0499 < sum(spent) < 0.05
    assert spent == sorted(spent, reverse=True)
    assert sum(level_of_look(0.05, look, 5) for look in range(1, 6)) == pytest.approx(0.05)


# --- error rates ---------------------------------------------------------------------------------

STUDIES = 500
LEVEL = 0.5  # of which a tenth is for typical runs
# A right test at 5 % exceeds this in one of 10,000 such checks.
MOST_WRONG = stats.binom.isf(1e-4, STUDIES, 0.05) / STUDIES


WORLDS = {
    "log-normal": lambda rng, shape: rng.lognormal(size=shape),
    "tied": lambda rng, shape: rng.choice([0.0, 0.5, 1.0], size=shape, p=[0.2, 0.2, 0.6]),
    "a steady agent beside one around it": lambda rng, shape: (
        np.array([[0.0], [1.0]]) * rng.choice([-1.0, 1.0], size=shape)
    ),
}


@pytest.mark.parametrize("n", [5, 12])
@pytest.mark.parametrize("world", WORLDS)
def test_agents_are_rarely_told_apart_or_called_equal_wrongly(world, n):
    rng, apart, equal = np.random.default_rng(0), 0, 0
    for _ in range(STUDIES):
        x, y = WORLDS[world](rng, (2, n))
        apart += judge_pairs({"x": x, "y": y}, 0.0, LEVEL)["x", "y"].typical in ("better", "worse")
        moved = {"x": x, "y": y + 1}
        equal += judge_pairs(moved, 1 - 1e-9, LEVEL)["x", "y"].typical == "equivalent"
    assert max(apart, equal) / STUDIES <= MOST_WRONG
