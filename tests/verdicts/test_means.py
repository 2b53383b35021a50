"""Claims about expected scores: tests, guards, intervals, and who is best."""

from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from verdicts import (
    Ends,
    compare_means,
    compare_pairs,
    fewest_seeds,
    judge_means,
    judge_pairs,
    mean_interval,
    rank_by_mean,
)
from verdicts.means import (
    MeanVerdict,
    ahead_on_average,
    paired_p_value,
    permutation_p_value,
    seeds_needed,
    seen_p_value,
    welch_p_value,
)

UNIT = Ends(0.0, 1.0)
SCORES = arrays(float, st.integers(5, 12), elements=st.floats(0, 1, width=16))


def normal_scores(n, mean=0.6, deviation=0.06):
    """The quantiles of a normal law: a sample that is what is expected of one."""
    z = stats.norm.ppf((np.arange(n) + 0.5) / n)
    return mean + deviation * z / z.std(ddof=1)


A, B = np.array([0.9, 0.8, 0.95, 0.7, 0.85]), np.array([0.6, 0.75, 0.5, 0.65, 0.72])


def test_welchs_test_is_scipys():
    expected = stats.ttest_ind(A, B, equal_var=False, alternative="greater").pvalue
    assert welch_p_value(A, B) == pytest.approx(expected)


def test_all_ways_to_deal_out_ten_scores_are_counted():
    pooled, statistic = np.concatenate([A, B]), []
    for first in combinations(range(10), 5):
        x, y = pooled[list(first)], np.delete(pooled, first)
        spread = x.var(ddof=1) / 5 + y.var(ddof=1) / 5
        statistic.append((x.mean() - y.mean()) / np.sqrt(spread))
    share = np.mean(np.array(statistic) >= statistic[0] - 1e-9)
    assert permutation_p_value(A, B) == pytest.approx(share)


def test_runs_that_share_their_seeds_are_held_against_each_other():
    apart = A - B
    flips = np.array([np.dot(signs, apart) for signs in product((1, -1), repeat=5)])
    expected = stats.ttest_rel(A, B, alternative="greater").pvalue
    assert paired_p_value(A, B) == pytest.approx(max(expected, np.mean(flips >= flips[0])))


@pytest.mark.parametrize("n", [5, 10, 50])
@pytest.mark.parametrize("share", [0, 0.2, 0.5, 1])
def test_of_zeros_and_ones_the_interval_is_that_of_clopper_and_pearson(n, share):
    n_ones = round(share * n)
    scores = np.repeat([1.0, 0.0], [n_ones, n - n_ones])
    low = stats.beta.ppf(0.025, n_ones, n - n_ones + 1) if n_ones else 0.0
    high = stats.beta.isf(0.025, n_ones + 1, n - n_ones) if n_ones < n else 1.0
    # The quantiles come from 4,000 draws.
    assert mean_interval(scores, 0.05) == pytest.approx((low, high), abs=0.02)


def test_what_does_not_depend_on_chance_has_no_interval():
    assert mean_interval([0.8] * 5, 0.05, exact=True) == pytest.approx((0.8, 0.8))


@given(SCORES, SCORES, st.sampled_from([0.05, 0.01]))
def test_intervals_say_what_the_tests_say(first, second, level):
    found, said = compare_means(first, second, level), judge_means(first, second, level)
    seen = min(seen_p_value(first, second), seen_p_value(second, first))
    sure = min(ahead_on_average(first, second), ahead_on_average(second, first))
    assert (said.verdict != "undecided") == (seen <= level / 2)
    if said.verdict != "undecided" and abs(sure - level / 2) > 0.1 * level:
        assert said.is_conditional == (sure > level / 2)
    by_interval = {"better": found.seen_low > -1e-4, "worse": found.seen_high < 1e-4}
    assert by_interval.get(said.verdict, found.seen_low <= 1e-4 <= found.seen_high + 2e-4)
    assert found.low <= found.seen_low <= found.seen_high <= found.high
    assert found.low <= found.point + 1e-9
    assert found.point <= found.high + 1e-9


@given(SCORES, SCORES)
def test_it_does_not_matter_who_stands_first(first, second):
    one, other = compare_means(first, second, 0.05), compare_means(second, first, 0.05).swapped()
    said = judge_means(first, second, 0.05, margin=0.02)
    assert said == judge_means(second, first, 0.05, margin=0.02).swapped()
    assert (one.low, one.high) == pytest.approx((other.low, other.high), abs=1e-4)


CASES = {
    # name: scores of two agents, the verdict on the first, and whether it has a condition
    "far apart": ([0.95, 0.94, 0.96, 0.95, 0.95], [0.2, 0.25, 0.22, 0.2, 0.2], "better", False),
    "three seeds": ([0.95, 0.94, 0.96], [0.2, 0.25, 0.22], "undecided", False),
    "a standard deviation apart": (
        normal_scores(20, 0.66),
        normal_scores(20),
        "better",
        True,
    ),
    "steady, and one of ten fails": (
        normal_scores(10, 0.95, 0.01),
        [*normal_scores(9, 0.9856, 0.004), 0],
        "undecided",
        False,
    ),
    "none against three of ten": ([0.95] * 10, [0.95] * 7 + [0.0] * 3, "undecided", False),
    "a fair coin that fell on one side": ([1.0] * 5, [0.5] * 5, "better", True),
    "all alike": ([0.86] * 5, [0.86] * 5, "equivalent", True),
    "the same at 200 seeds": (
        normal_scores(200, 0.95, 0.01),
        normal_scores(200, 0.95, 0.01),
        "equivalent",
        False,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_said_of_two_agents(case):
    first, second, verdict, is_conditional = CASES[case]
    said = judge_means(first, second, 0.05, margin=0.02)
    assert (said.verdict, said.is_conditional) == (verdict, is_conditional)


def test_a_claim_with_a_condition_turns_round_where_that_share_lies_outside():
    x, y = normal_scores(20, 0.66), normal_scores(20)
    found = compare_means(x, y, 0.05)
    q = found.most_outside
    worst = (1 - q) * x.mean() + q * 0, (1 - q) * y.mean() + q * 1
    assert worst[0] - worst[1] == pytest.approx(x.mean() - y.mean() - found.seen_low)


def test_the_best_is_told_from_each_other_without_a_price_for_their_number():
    best, others = np.full(10, 0.97), [np.full(10, score) for score in (0.4, 0.3, 0.2)]
    best, *others = (each + normal_scores(10, 0, 0.01) for each in (best, *others))
    assert rank_by_mean([best, *others], 0.05) >= 1
    assert rank_by_mean([best, best, *others], 0.05) == 0
    judged = judge_pairs(dict(zip("abcd", [best, *others], strict=True)), 0.02, 0.05, ends=UNIT)
    assert {judged["a", other].mean.verdict for other in "bcd"} == {"better"}
    assert not any(judged["a", other].mean.is_conditional for other in "bcd")


def test_who_is_best_may_have_a_condition_too():
    # So far ahead that it shows against each, if not against all pairs at once, nor with the guard.
    best, others = normal_scores(10, 0.66), [normal_scores(10, mean) for mean in (0.58, 0.579)]
    scores = dict(zip("abc", [best, *others], strict=True))
    assert rank_by_mean([*scores.values()], 0.02) == 0
    assert rank_by_mean([*scores.values()], 0.02, seen_only=True) == 1
    for pair in compare_pairs(scores, ends=(0, 1), seed=0)[:2]:
        assert judge_means(best, scores[pair.second], 0.05 / 3) == MeanVerdict("better", True)
        assert pair.said == MeanVerdict("better", True)
        assert 0 < pair.mean.seen_low < 0.08 < pair.mean.seen_high
        assert pair.mean.most_outside > 0


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ([1.0] * 9 + [0.9], MeanVerdict("better")),
        ([1.0] * 9 + [1 - 1e-12], MeanVerdict("equivalent", True)),
        ([1.0] * 4, MeanVerdict("undecided")),
    ],
)
def test_who_always_has_the_most_there_is_is_ahead_of_whoever_once_had_less(other, said):
    most = np.ones(len(other))
    assert judge_means(most, other, 0.05, margin=0.02, exact=(True, False)) == said
    assert judge_means(other, most, 0.05, margin=0.02, exact=(False, True)) == said.swapped()
    # The same from below, where an agent always has the least.
    least, other = 1 - most, 1 - np.array(other)
    assert judge_means(other, least, 0.05, margin=0.02, exact=(False, True)) == said
    # Of one that only had the most so far nothing is known.
    assert judge_means(most, 1 - other, 0.05, margin=0.0).verdict == "undecided"


@given(st.lists(SCORES, min_size=3, max_size=5), st.floats(0.01, 0.2))
def test_better_has_no_circles(runs, level):
    n = min(map(len, runs))
    scores = {str(k): each[:n] for k, each in enumerate(runs)}
    judged = judge_pairs(scores, 0.0, level, ends=UNIT)
    said = {pair: each.mean for pair, each in judged.items()}
    said |= {(b, a): mean.swapped() for (a, b), mean in said.items()}
    better = {pair for pair, mean in said.items() if mean.verdict == "better"}
    assert all(scores[a].mean() > scores[b].mean() for a, b in better)
    sure = {pair for pair in better if not said[pair].is_conditional}
    assert all((a, d) in sure for a, b in sure for c, d in sure if b == c)


def test_few_seeds_claim_nothing():
    assert fewest_seeds(0.045) == 5
    assert fewest_seeds(0.045, n_pairs=45) == 7
    needed = seeds_needed(np.array([0.95, 0.94, 0.96]), np.array([0.2, 0.25, 0.22]), 0.05)
    assert needed == 5


def test_a_fair_coin_beside_its_middle_is_called_ahead_only_with_a_condition():
    """Two in 32 studies of five seeds see one side of it alone."""
    for side in (0.0, 1.0):
        scores = {"steady": np.full(5, 0.5), "coin": np.full(5, side)}
        mean = judge_pairs(scores, 0, 0.045, ends=UNIT)["steady", "coin"].mean
        assert mean.verdict in ("better", "worse")
        assert mean.is_conditional
