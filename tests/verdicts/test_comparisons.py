"""Comparisons of two agents: pairs, rank-sum tests and means, by hand, by SciPy, in simulation."""

from functools import partial
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from verdicts import (
    Ends,
    ahead_p_value,
    apart_p_value,
    compare_means,
    compare_pairs,
    describe_pairs,
    equivalent_p_value,
    fewest_seeds,
    holm,
    judge_means,
    judge_pairs,
    level_of_environment,
    level_of_look,
    mean_interval,
    paired_difference,
    probability_of_improvement,
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
from verdicts.rank_tests import interval_places, rank_sum_p_value, share_p_value, wins_of
from verdicts.resampling import interval_tail

NAN = np.nan
QUICK = {"seed": 0, "n_resamples": 50}
# Differences of few levels, so that ties come up.
PAIRS = st.integers(2, 9).flatmap(
    lambda n: st.tuples(*[st.lists(st.integers(-3, 3), min_size=n, max_size=n)] * 2)
)
# Scores of an agent on several seeds.
SCORES = arrays(float, st.integers(5, 12), elements=st.floats(0, 1, width=16))


def interval(found):
    return [found.low, found.high]


# --- probability of improvement ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "point", "n", "n_missing"),
    [
        ([2], [1], 1, 1, 0),
        ([1, NAN], [NAN, 1], NAN, 0, 2),
        ([np.inf, 1], [np.inf, 0], 0.625, 2, 0),
        ([0.3], [0.1 + 0.2], 0.5, 1, 0),  # in the last bits alone
        # Environments are averaged.
        ([[1, 5], [2, 5], [3, NAN]], [[0, 5], [0, 5], [0, 5]], 0.75, 5, 1),
        ([[0, 5], [0, 5], [0, 5]], [[1, 5], [2, 5], [3, NAN]], 0.25, 5, 1),
    ],
)
def test_who_wins(first, second, point, n, n_missing):
    found = probability_of_improvement(first, second, seed=0)
    assert (found.n, found.n_missing) == (n, n_missing)
    assert found.point == pytest.approx(point, nan_ok=True)
    assert found.has_interval == (n > 1)


@given(PAIRS)
def test_the_probability_is_the_mann_whitney_statistic(pair):
    first, second = pair
    found = probability_of_improvement(first, second, **QUICK)
    statistic = stats.mannwhitneyu(first, second).statistic
    assert found.point == pytest.approx(statistic / len(first) ** 2)
    assert 0 <= found.low <= found.point <= found.high <= 1


def test_seeds_of_each_environment_are_resampled_by_themselves():
    first, second = np.random.default_rng(0).normal([[[0.3, 2]]], 1, size=(2, 6, 2))
    rng = np.random.default_rng(3)
    wins, influence = [], []
    for x, y in zip(first.T, second.T, strict=True):
        drawn = rng.integers(6, size=(500, 6))
        wins.append([np.mean(x[rows][:, None] > y[rows]) for rows in drawn])
        influence.append([np.mean(x[i] > y) + np.mean(x > y[i]) for i in range(6)])
    tail = interval_tail([np.array(values) for values in influence], 0.95)
    found = probability_of_improvement(first, second, seed=3, n_resamples=500)
    assert interval(found) == pytest.approx(np.quantile(np.mean(wins, axis=0), [tail, 1 - tail]))


def test_winning_always_leaves_a_doubt():
    found = probability_of_improvement([2, 3, 4, 5, 6], [1] * 5, seed=0)
    exact = stats.binomtest(5, 5).proportion_ci(method="exact")
    assert [found.point, *interval(found)] == pytest.approx([1, exact.low, 1])
    lost = probability_of_improvement([[1, 1]] * 5, [[2, 2]] * 5, seed=0)
    exact = stats.binomtest(0, 10).proportion_ci(method="exact")
    assert [lost.point, *interval(lost)] == pytest.approx([0, 0, exact.high])


def test_of_many_seeds_the_interval_is_that_of_leaving_one_out():
    """The jackknife has the variance of DeLong; two environments alike halve it."""
    n = 250
    first, second = np.random.default_rng(0).normal([[0.3], [0]], 1, size=(2, n))
    wins = first[:, None] > second
    without = (wins.sum() - wins.sum(axis=0) - wins.sum(axis=1) + np.diag(wins)) / (n - 1) ** 2
    half = stats.norm.isf(0.05) * np.sqrt((n - 1) * without.var())
    for k in (1, 2):
        several = (np.tile(each, (k, 1)).T for each in (first, second))
        found = probability_of_improvement(*several, seed=0, confidence=0.9)
        ends = wins.mean() - half / k**0.5, wins.mean() + half / k**0.5
        assert interval(found) == pytest.approx(ends, abs=2e-4)


@pytest.mark.parametrize(("truth", "n"), [(0.95, 5), (0.7, 30)])
def test_the_interval_of_the_probability_covers(truth, n):
    rng = np.random.default_rng(0)
    ahead = stats.norm.ppf(truth) * np.sqrt(2)
    hits = []
    for trial in range(500):
        first, second = rng.normal(size=(2, n))
        found = probability_of_improvement(first + ahead, second, seed=trial, n_resamples=500)
        hits.append(found.low <= truth <= found.high)
    # Standard error 0.01. Beside 1 the interval is cautious.
    assert np.mean(hits) >= 0.915
    assert np.mean(hits) <= (1 if truth > 0.9 else 0.985)


# --- paired differences --------------------------------------------------------------------------


def test_the_paired_interval_is_scipys():
    first, second = np.random.default_rng(0).normal(size=(2, 9))
    expected = stats.ttest_rel(first, second)
    ends = expected.confidence_interval(0.9)
    found = paired_difference(first, second, confidence=0.9)
    assert interval(found) == pytest.approx([ends.low, ends.high])
    assert found.point == pytest.approx(np.mean(first - second))


@pytest.mark.parametrize(
    ("first", "second", "expected", "n_missing"),
    [
        # Seeds that one agent lacks do not count.
        ([1, NAN, 5, np.inf, 8, 7], [0, 3, 2, 1, 3, -np.inf], (3, -1.968, 7.968), 3),
        ([1, 2, 3], [1, 2, 3], (0, 0, 0), 0),
        ([0.4, 0.4], [0.1, 0.1], (0.3, 0.3, 0.3), 0),
        ([0.3, 0.6], [0.1 + 0.2, 0.2 + 0.4], (0, 0, 0), 0),  # in the last bits alone
        ([3], [1], (2, NAN, NAN), 0),
        ([NAN], [1], (NAN, NAN, NAN), 1),
    ],
)
def test_differences_by_hand(first, second, expected, n_missing):
    found = paired_difference(first, second)
    assert found.n_missing == n_missing
    assert [found.point, *interval(found)] == pytest.approx(expected, abs=5e-4, nan_ok=True)


# --- Holm ----------------------------------------------------------------------------------------


def test_holm_worked_by_hand():
    # Sorted .005 .01 .03 .04, times 4 3 2 1: .02 .03 .06 .04, and never falling: .02 .03 .06 .06.
    assert holm([0.01, 0.04, 0.03, 0.005]).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.6]).tolist() == [1, 1]
    assert holm([]).tolist() == []
    # Tests that were not made do not count.
    assert holm([0.02, NAN, 0.01]).tolist() == pytest.approx([0.02, NAN, 0.02], nan_ok=True)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_keeps_the_order_and_lies_between_raw_and_bonferroni(p_values):
    raw, adjusted = np.array(p_values), holm(p_values)
    order = np.argsort(raw, kind="stable")
    assert (np.diff(adjusted[order]) >= 0).all()
    assert (adjusted >= raw).all()
    assert (adjusted <= np.minimum(1, raw * len(raw))).all()
    assert adjusted[order[0]] == min(1, raw.min() * len(raw))


# --- verdicts ------------------------------------------------------------------------------------

NOISE = np.array([-0.3, 0.2, 0.1, -0.2, 0.3, -0.1])


def verdicts(scores, margin=0.0, **arguments):
    found = compare_pairs(scores, margin, **QUICK, **arguments)
    return {(one.first, one.second): one.verdict for one in found}


def test_a_comparison_holds_its_parts_together():
    rng = np.random.default_rng(2)
    first, second = rng.normal(size=8) + 0.5, rng.normal(size=8)
    first[0] = np.inf
    (one,) = compare_pairs({"x": first, "y": second}, 0.1, seed=5, ends=(-3, 3))
    assert one.mean.point == pytest.approx((first[1:].mean() - second.mean()) / 6)
    found = probability_of_improvement(first[1:], second[1:], seed=5)
    assert interval(one.probability_of_improvement) == interval(found)
    assert one.probability_of_improvement.n == 7
    assert (one.verdict, one.typical) == ("undecided", "undecided")
    assert one.seeds_needed > 7


def test_a_sure_difference_within_the_margin_is_equivalent():
    scores = {"x": 0.4 + 0.01 * NOISE, "y": np.zeros(6)}
    assert verdicts(scores) == {("x", "y"): "better"}
    (one,) = compare_pairs(scores, 0.5, ends=(-1, 1), **QUICK)
    assert one.verdict == "equivalent"
    assert 0.19 < one.mean.seen_low <= one.mean.seen_high < 0.25


def test_the_typical_run_is_another_question_than_the_mean():
    steady, failing = np.full(40, 0.95), np.where(np.arange(40) < 4, 0.0, 0.98)
    (one,) = compare_pairs({"x": steady, "y": failing}, ends=(0, 1), **QUICK)
    assert (one.verdict, one.typical) == ("undecided", "worse")
    assert one.mean.point > 0
    # A typical run lies within the margin, but one in four lies beyond it, always on one side.
    often = {"x": np.repeat([0.0, 5.0], [30, 10]), "y": np.zeros(40)}
    assert compare_pairs(often, 1.0, **QUICK)[0].typical == "better"


def test_many_pairs_and_later_looks_ask_for_more():
    first, second = np.arange(6) + 4.5, np.arange(6.0)
    (alone,) = compare_pairs({"x": first, "y": second}, **QUICK)
    crowd = {name: second + 0.01 * k for k, name in enumerate("abcde")}
    among = compare_pairs({"x": first, "y": second, **crowd}, **QUICK)[0]
    assert among.mean.seen_low < alone.mean.seen_low
    scores = {"x": np.arange(6) + 3.5, "y": np.arange(6.0)}
    pair = ("x", "y")
    assert verdicts(scores)[pair] == "better"
    assert verdicts(scores, look=2)[pair] == "undecided"
    with pytest.raises(ValueError, match="look is 3, it must lie between 1 and 2"):
        verdicts(scores, look=3, n_looks=2)


def test_agents_without_chance_are_told_apart_by_what_they_are():
    scores = {"x": [1.0] * 2, "y": [1.0] * 2, "z": [0.9, NAN], "learner": [1.0] * 2}
    found = compare_pairs(scores, 0.01, certain="xyz", ends=(0, 1), **QUICK)
    assert [one.verdict for one in found] == [
        *("equivalent", "better", "undecided", "better", "undecided", "undecided")
    ]
    assert [one.certain for one in found] == [True, True, False, True, False, False]
    assert found[1].mean.low == found[1].mean.high == pytest.approx(0.1)
    # No run that was not seen can be another.
    learner = {"plan": np.ones(10), "learner": 0.9 + 0.01 * np.tile([-1.0, 1.0], 5)}
    said = [
        compare_pairs(learner, ends=(0, 1), certain=certain, **QUICK)[0].is_conditional
        for certain in ((), ("plan",))
    ]
    assert said == [True, False]


@settings(deadline=None, max_examples=40)
@given(PAIRS, st.sampled_from([0, 0.5, 2]), st.sampled_from([0.25, 4]), st.integers(-100, 100))
def test_what_holds_of_every_comparison(pair, margin, scale, shift):
    first, second = map(np.array, pair)
    (one,) = compare_pairs({"x": first, "y": second}, margin, **QUICK)
    # Neither does the unit matter nor who stands first.
    moved = {"y": second * scale + shift, "x": first * scale + shift}
    (other,) = compare_pairs(moved, margin * scale, **QUICK)
    turned = one.swapped()
    for name in ("first", "second", "said", "typical", "seeds_needed", "n_seeds"):
        assert getattr(turned, name) == getattr(other, name), name
    for name in ("mean", "probability_of_improvement"):
        found, expected = (list(vars(getattr(each, name)).values()) for each in (turned, other))
        assert found == pytest.approx(expected, abs=1e-4, nan_ok=True), name
    # Intervals are possible, and say what the verdict says.
    mean = one.mean
    assert -1 <= mean.low <= mean.seen_low <= mean.seen_high <= mean.high <= 1
    low, high = (mean.seen_low, mean.seen_high) if one.is_conditional else (mean.low, mean.high)
    within = -margin <= low <= high <= margin
    assert {"better": low >= 0, "worse": high <= 0, "equivalent": within}.get(one.verdict, True)
    if one.verdict == "undecided":
        assert mean.seen_low <= 1e-4
        assert mean.seen_high >= -1e-4
        assert one.seeds_needed is None or one.seeds_needed > len(first)
    else:
        assert one.seeds_needed is None


STEPS = [  # of which the higher two are told apart, and their interval alone goes beyond 0
    np.array([0.01, 0.14, 0.16, 0.17, 0.08, 0.14, 0.25, 0.16]),
    np.array([0.45, 0.47, 0.40, 0.49, 0.35, 0.36, 0.45, 0.42]),
    np.array([0.84, 0.81, 0.79, 0.82, 0.73, 0.76, 0.73, 0.71]),
]


@settings(deadline=None, max_examples=40)
@given(st.lists(SCORES, min_size=3, max_size=4), st.sampled_from([0.0, 0.5]))
@example(STEPS, 0.0)
@example(STEPS[::-1], 0.0)
def test_intervals_lie_on_the_side_of_their_verdicts_among_many_too(runs, margin):
    """Holm tests a pair at a level that its interval need not have."""
    n = min(map(len, runs))
    scores = {str(k): each[:n] for k, each in enumerate(runs)}
    for pair in compare_pairs(scores, margin, ends=(0, 1), **QUICK):
        mean, claimed = pair.mean, pair.said.verdict
        low, high = (mean.seen_low, mean.seen_high) if pair.is_conditional else interval(mean)
        least, most = {
            "better": (0, 1), "worse": (-1, 0), "equivalent": (-margin, margin)
        }.get(claimed, (-1, 1))  # fmt: skip
        assert least <= low <= high <= most


def test_each_pair_has_its_share_of_the_error_rate():
    """Of the first of unknown looks 90 %, of this 75 % for means, half of it for who is best."""
    rng = np.random.default_rng(0)
    scores = {name: rng.beta(3, 2, size=9) for name in "abc"}
    for names, share in (("ab", 1), ("abc", 2 * 3)):
        given = {name: scores[name] for name in names}
        found = compare_pairs(given, 0.05, ends=(0, 1), **QUICK)[0]
        assert found.mean == compare_means(*(scores[n] for n in "ab"), 0.045 * 0.75 / share)
        # The next look has half of a tenth; about so many seeds then show the difference.
        n_pairs = len(names) * (len(names) - 1) // 2
        quantiles = stats.norm.isf([0.0025 * 0.75 / n_pairs / 2, 0.2])
        apart = scores["a"].mean() - scores["b"].mean()
        variance = scores["a"].var(ddof=1) + scores["b"].var(ddof=1)
        reach = max(abs(apart), 0.05 - abs(apart))
        assert found.seeds_needed == np.ceil(sum(quantiles) ** 2 * variance / reach**2) + 1


def test_looks_and_environments_spend_no_more_than_there_is():
    spent = [level_of_look(0.05, look) for look in range(1, 1000)]
    assert 0.0499 < sum(spent) < 0.05
    assert spent == sorted(spent, reverse=True)
    assert sum(level_of_look(0.05, look, 5) for look in range(1, 6)) == pytest.approx(0.05)
    # Where there are several environments, all of them together are one more.
    shares = [level_of_environment(0.06, n) for n in (1, 2, 3)]
    assert shares == pytest.approx([0.06, 0.02, 0.015])


@pytest.mark.parametrize(
    ("scores", "options", "message"),
    [
        (([1, 2], [1, 2, 3]), {}, r"different shapes, .*'y': \(3,\)"),
        (([[1, 2]], [[1, 2]]), {}, r"they must have \(n_seeds,\)"),
        (([1, 2], [1, 2]), {"margin": -1}, "margin is -1"),
        (([1, 2], [1, 2]), {"confidence": 95}, "confidence is 95"),
        *((([1, 2], [1, 2]), {"ends": ends}, "ends are") for ends in ((1, 0), (-np.inf, 0))),
    ],
)
def test_wrong_arguments_are_named(scores, options, message):
    with pytest.raises(ValueError, match=message):
        compare_pairs(dict(zip("xy", scores, strict=True)), seed=0, **options)


def test_scores_that_do_not_pair_up_are_refused():
    for compare in (partial(probability_of_improvement, seed=0), paired_difference):
        with pytest.raises(ValueError, match="do not pair up"):
            compare([1, 2], [1, 2, 3])


# === rank-sum tests ===============================================================================


FEW_SCORES = st.lists(st.integers(0, 3), min_size=2, max_size=5)


@given(FEW_SCORES, FEW_SCORES)
def test_the_rank_sum_test_counts_every_split(first, second):
    pooled = stats.rankdata([*first, *second])
    sums = [sum(pooled[list(rows)]) for rows in combinations(range(len(pooled)), len(first))]
    expected = np.mean(np.array(sums) >= pooled[: len(first)].sum())
    found = rank_sum_p_value(np.array(first, float), np.array(second, float))
    assert found == pytest.approx(expected)


def test_many_scores_with_ties_are_tested_as_counted_ones():
    # Fisher's exact test is the rank-sum test of scores that are 0 or 1.
    first, second = np.repeat([0.0, 1.0], [2, 28]), np.repeat([0.0, 1.0], [10, 20])
    exact = stats.fisher_exact([[28, 2], [20, 10]], alternative="greater").pvalue
    assert rank_sum_p_value(first, second) == pytest.approx(exact, rel=0.2)
    assert rank_sum_p_value(np.ones(40), np.ones(40)) == 1
    # As many as are counted out.
    first, second = np.random.default_rng(20).normal([[0.5], [0]], 1, size=(2, 20))
    expected = stats.mannwhitneyu(first, second, alternative="greater", method="exact").pvalue
    assert rank_sum_p_value(first, second) == pytest.approx(expected)


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


# --- error rates ---------------------------------------------------------------------------------

STUDIES = 250
TYPICAL_LEVEL = 0.5  # of which a tenth is for typical runs
# A right test at 5 % exceeds this in one of 10,000 such checks.
MOST_WRONG = stats.binom.isf(1e-4, STUDIES, 0.05) / STUDIES


WORLDS = {
    "log-normal": lambda rng, shape: rng.lognormal(size=shape),
    "tied": lambda rng, shape: rng.choice([0.0, 0.5, 1.0], size=shape, p=[0.2, 0.2, 0.6]),
    "a steady agent beside one around it": lambda rng, shape: (
        np.array([[0.0], [1.0]]) * rng.choice([-1.0, 1.0], size=shape)
    ),
}


@pytest.mark.parametrize(
    ("world", "n"), [("log-normal", 12), ("tied", 5), ("a steady agent beside one around it", 5)]
)
def test_agents_are_rarely_told_apart_or_called_equal_wrongly(world, n):
    rng, apart, equal = np.random.default_rng(0), 0, 0
    for _ in range(STUDIES):
        x, y = WORLDS[world](rng, (2, n))
        said = judge_pairs({"x": x, "y": y}, 0.0, TYPICAL_LEVEL)["x", "y"].typical
        apart += said in ("better", "worse")
        moved = {"x": x, "y": y + 1}
        equal += judge_pairs(moved, 1 - 1e-9, TYPICAL_LEVEL)["x", "y"].typical == "equivalent"
    assert max(apart, equal) / STUDIES <= MOST_WRONG


# === claims about expected scores =================================================================


UNIT = Ends(0.0, 1.0)


def normal_scores(n, mean=0.6, deviation=0.06):
    """The quantiles of a normal law: a sample that is what is expected of one."""
    z = stats.norm.ppf((np.arange(n) + 0.5) / n)
    return mean + deviation * z / z.std(ddof=1)


def every_split(first, second):
    """The share of all ways to deal the scores out with at least this statistic of Welch."""
    pooled, statistic = np.concatenate([first, second]), []
    for rows in combinations(range(len(pooled)), len(first)):
        x, y = pooled[list(rows)], np.delete(pooled, rows)
        spread = x.var(ddof=1) / len(x) + y.var(ddof=1) / len(y)
        statistic.append((x.mean() - y.mean()) / np.sqrt(spread))
    return np.mean(np.array(statistic) >= statistic[0] - 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_of_runs_that_were_seen_the_larger_of_two_p_values_counts(seed):
    x, y = np.random.default_rng(seed).normal([[1.0], [0]], 1, size=(2, 5))
    by_t = stats.ttest_ind(x, y, equal_var=False, alternative="greater").pvalue
    assert welch_p_value(x, y) == pytest.approx(by_t)
    assert permutation_p_value(x, y) == pytest.approx(every_split(x, y))
    assert seen_p_value(x, y) == pytest.approx(max(by_t, every_split(x, y)))


@pytest.mark.parametrize("n", [5, 8, 11, 12])
@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_runs_that_share_their_seeds_are_held_against_each_other(n, spread):
    """Their signs are flipped in all ways, where that can show as much as the t test."""
    apart = np.linspace(1.0 - spread, 1.0 + spread, n)
    first, second = np.arange(n) + apart, np.arange(n, dtype=float)
    flips = np.array([np.dot(signs, apart) for signs in product((1, -1), repeat=n)])
    by_t = stats.ttest_rel(first, second, alternative="greater").pvalue
    by_signs = np.mean(flips >= flips[0] - 1e-9) if n < 12 else 0.0
    assert paired_p_value(first, second) == pytest.approx(max(by_t, by_signs))


@pytest.mark.parametrize(("n", "within"), [(5, 0.02), (10, 0.02), (50, 0.02), (3000, 0.002)])
@pytest.mark.parametrize("share", [0, 0.2, 0.5, 1])
def test_of_zeros_and_ones_the_interval_is_that_of_clopper_and_pearson(n, within, share):
    n_ones = round(share * n)
    scores = np.repeat([1.0, 0.0], [n_ones, n - n_ones])
    low = stats.beta.ppf(0.025, n_ones, n - n_ones + 1) if n_ones else 0.0
    high = stats.beta.isf(0.025, n_ones + 1, n - n_ones) if n_ones < n else 1.0
    # The quantiles come from 4,000 draws.
    assert mean_interval(scores, 0.05) == pytest.approx((low, high), abs=within)
    # What does not depend on chance has no interval.
    assert mean_interval(np.full(n, share), 0.05, exact=True) == pytest.approx((share, share))


@settings(deadline=None, max_examples=40)
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
    "a little apart, which nothing could turn round": (
        normal_scores(400, 0.912, 0.001),
        normal_scores(400, 0.9, 0.001),
        "better",
        False,
    ),
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
    assert judge_means(second, first, 0.05, margin=0.02) == said.swapped()


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


def test_against_one_agent_the_others_are_not_tested():
    old, far, low = (normal_scores(20, mean) for mean in (0.5, 0.7, 0.3))
    scores = {"old": old, "far": far, "further": far + 0.1, "low": low}
    judged = judge_pairs(scores, 0.0, 0.05, ends=UNIT, against="old")
    said = {pair: each.mean.verdict for pair, each in judged.items()}
    assert [said["old", name] for name in ("far", "further", "low")] == ["worse"] * 2 + ["better"]
    assert said["far", "further"] == "undecided"  # though they are as far apart as old and far
    assert said["far", "low"] == said["further", "low"] == "better"  # follows
    # Each of three pairs has a third, where each of six would have a twelfth beside a ranking.
    ahead = normal_scores(20, 0.555)
    close = {"old": old, "a": ahead, "b": ahead, "c": old}
    assert judge_pairs(close, 0.0, 0.05, ends=UNIT)["old", "a"].mean.verdict == "undecided"
    few = judge_pairs(close, 0.0, 0.05, ends=UNIT, against="old")
    assert few["old", "a"].mean == MeanVerdict("worse", is_conditional=True)
    assert few["old", "a"].mean == judge_means(old, close["a"], 0.05 * 0.75 / 3)
    described = describe_pairs(
        {pair: (each, 20) for pair, each in judged.items()},
        scores,
        0.0,
        (0.05, 0.05),
        UNIT,
        seed=0,
        against="old",
    )
    untested = next(pair for pair in described if (pair.first, pair.second) == ("far", "further"))
    assert (untested.mean.low, untested.mean.high, untested.seeds_needed) == (-1, 1, None)


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
    # A loss that is too small to be within the margin's reach is one all the same.
    once = [1.0] * 9 + [1 - 1e-8]
    assert judge_means(np.ones(10), once, 0.05, exact=(True, False)) == MeanVerdict("better")
    # Of one that only had the most so far nothing is known.
    assert judge_means(most, 1 - other, 0.05, margin=0.0).verdict == "undecided"


def test_few_seeds_claim_nothing():
    assert (fewest_seeds(0.045), fewest_seeds(0.045, n_pairs=45)) == (5, 7)
    x, y = np.array([0.95, 0.94, 0.96, 0.95]), np.array([0.2, 0.25, 0.22, 0.21])
    assert seeds_needed(x, y, 0.05) == 5
    found = compare_means(x, y, 0.05)
    assert (found.low, found.high, found.seen_low, found.seen_high) == (-1, 1, -1, 1)
    (one,) = compare_pairs({"x": [*x, NAN], "y": [*y, 0.2]}, 10, **QUICK)
    assert (one.verdict, one.typical) == ("undecided", "undecided")


@settings(deadline=None, max_examples=40)
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
