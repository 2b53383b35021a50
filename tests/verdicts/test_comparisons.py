"""Comparisons of two agents: worked by hand, against closed forms, and in simulation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from verdicts import (
    compare_pairs,
    holm,
    paired_difference,
    probability_of_improvement,
)
from verdicts.resampling import interval_tail

NAN = np.nan
QUICK = {"seed": 0, "n_resamples": 50}
# Differences of few levels, so that ties come up.
PAIRS = st.integers(2, 9).flatmap(
    lambda n: st.tuples(*[st.lists(st.integers(-3, 3), min_size=n, max_size=n)] * 2)
)
OPPOSITE = {"better": "worse", "worse": "better"}


def interval(found):
    return [found.low, found.high]


# --- probability of improvement ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "point", "n", "n_missing"),
    [
        ([2], [1], 1, 1, 0),
        ([NAN], [1], NAN, 0, 1),
        ([np.inf, 1], [np.inf, 0], 0.625, 2, 0),
        ([0.3], [0.1 + 0.2], 0.5, 1, 0),  # in the last bits alone
        # Environments are averaged.
        ([[1, 5], [2, 5], [3, NAN]], [[0, 5], [0, 5], [0, 5]], 0.75, 5, 1),
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


@given(PAIRS)
def test_the_two_probabilities_add_up_to_one(pair):
    one = probability_of_improvement(*pair, **QUICK)
    other = probability_of_improvement(*reversed(pair), **QUICK)
    assert one.point + other.point == pytest.approx(1)
    assert interval(one) == pytest.approx([1 - other.high, 1 - other.low])
    assert 0 <= one.low <= one.point <= one.high <= 1


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


def test_each_verdict():
    noise = np.concatenate([NOISE, NOISE / 2])
    scores = {
        "base": np.zeros(12),
        "ahead": 5 + noise,
        "behind": -5 + noise,
        "close": 0.1 * noise,
        "noisy": 0.1 + 10 * noise,
    }
    found = verdicts(scores, margin=0.5)
    assert found["base", "ahead"] == "worse"
    assert found["base", "behind"] == "better"
    assert found["base", "close"] == "equivalent"
    assert found["base", "noisy"] == "undecided"


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


def test_few_seeds_leave_everything_undecided():
    for n in (2, 4):
        (one,) = compare_pairs({"x": [5] * n + [NAN], "y": [1] * (n + 1)}, 10, **QUICK)
        assert (one.verdict, one.typical) == ("undecided", "undecided")
        assert (one.mean.low, one.mean.high) == (-1, 1)


@given(PAIRS, st.sampled_from([0, 0.5, 2]))
def test_the_other_way_round_is_the_opposite(pair, margin):
    first, second = pair
    (one,) = compare_pairs({"x": first, "y": second}, margin, **QUICK)
    (other,) = compare_pairs({"y": second, "x": first}, margin, **QUICK)
    assert other.verdict == OPPOSITE.get(one.verdict, one.verdict)
    assert other.typical == OPPOSITE.get(one.typical, one.typical)
    turned = one.swapped()
    assert (turned.first, turned.second, turned.said) == ("y", "x", other.said)
    assert turned.seeds_needed == other.seeds_needed
    assert list(vars(turned.mean).values()) == pytest.approx(
        list(vars(other.mean).values()), abs=1e-4, nan_ok=True
    )
    found, expected = turned.probability_of_improvement, other.probability_of_improvement
    assert [found.point, *interval(found)] == pytest.approx(
        [expected.point, *interval(expected)], nan_ok=True
    )


@given(PAIRS, st.sampled_from([0, 0.5]), st.sampled_from([0.25, 4]), st.integers(-100, 100))
def test_the_unit_of_the_scores_does_not_matter(pair, margin, scale, shift):
    first, second = map(np.array, pair)
    (one,) = compare_pairs({"x": first, "y": second}, margin, **QUICK)
    moved = {"x": first * scale + shift, "y": second * scale + shift}
    (other,) = compare_pairs(moved, margin * scale, **QUICK)
    assert (one.said, one.typical) == (other.said, other.typical)
    assert other.probability_of_improvement == one.probability_of_improvement


@given(PAIRS, st.sampled_from([0, 1]))
def test_undecided_asks_for_more_seeds_than_there_are(pair, margin):
    (one,) = compare_pairs(dict(zip("xy", pair, strict=True)), margin, **QUICK)
    if one.verdict == "undecided" and one.seeds_needed is not None:
        assert one.seeds_needed > one.probability_of_improvement.n
    else:
        assert one.seeds_needed is None


@given(PAIRS, st.sampled_from([0, 0.5, 2]))
def test_intervals_are_possible_and_say_what_verdicts_say(pair, margin):
    (one,) = compare_pairs(dict(zip("xy", pair, strict=True)), margin, **QUICK)
    mean = one.mean
    assert -1 <= mean.low <= mean.seen_low <= mean.seen_high <= mean.high <= 1
    low, high = (mean.seen_low, mean.seen_high) if one.is_conditional else (mean.low, mean.high)
    if one.verdict in OPPOSITE:
        assert low >= 0 if one.verdict == "better" else high <= 0
    elif one.verdict == "undecided":
        assert mean.seen_low <= 1e-4
        assert mean.seen_high >= -1e-4


@pytest.mark.parametrize(
    ("scores", "options", "message"),
    [
        (([1, 2], [1, 2, 3]), {}, r"different shapes, .*'y': \(3,\)"),
        (([[1, 2]], [[1, 2]]), {}, r"they must have \(n_seeds,\)"),
        (([1, 2], [1, 2]), {"margin": -1}, "margin is -1"),
        (([1, 2], [1, 2]), {"confidence": 95}, "confidence is 95"),
        (([1, 2], [1, 2]), {"ends": (1, 0)}, "ends are"),
    ],
)
def test_wrong_arguments_are_named(scores, options, message):
    with pytest.raises(ValueError, match=message):
        compare_pairs(dict(zip("xy", scores, strict=True)), seed=0, **options)


def test_scores_that_do_not_pair_up_are_refused():
    with pytest.raises(ValueError, match="do not pair up"):
        probability_of_improvement([1, 2], [1, 2, 3], seed=0)
    with pytest.raises(ValueError, match="do not pair up"):
        paired_difference([1, 2], [1, 2, 3])
