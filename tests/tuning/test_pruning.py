"""Trials are ended early when they are hopeless, and not before."""

import statistics

import pytest

from pipeline.errors import UserError
from tuning.pruning import PRUNERS, is_hopeless


def scored(*scores, first=0):
    return {first + number: score for number, score in enumerate(scores)}


@pytest.mark.parametrize("method", PRUNERS)
def test_the_first_trial_and_the_best_one_go_on_and_the_worst_of_many_does_not(method):
    assert not is_hopeless({}, [], method)
    assert not is_hopeless(scored(0.1, 0.1), [], method)
    others = [scored(*[0.1 * n] * 12) for n in range(8)]
    assert not any(is_hopeless(scored(*[0.8] * n), others, method) for n in range(1, 12))
    better = [scored(*[0.5 + 0.05 * n] * 12) for n in range(8)]
    ended = [is_hopeless(scored(*[0.0] * n), better, method) for n in range(1, 12)]
    assert any(ended) is (method != "none")


@pytest.mark.parametrize(
    ("scores", "hopeless"),
    [
        ([0.9], False),  # 0.9 and twice 1.0 is more than 2.8
        ([0.8], False),  # and this a draw
        ([0.79], True),
        ([1.0, 0.8], False),
        ([1.0, 0.79], True),
        ([1.0, 1.0, 0.1], False),  # nothing is left to save
    ],
)
def test_the_bound_counts_what_is_left_as_perfect(scores, hopeless):
    others = [scored(0.9, 0.9, 1.0), scored(1.0, 0.2)]
    assert is_hopeless(scored(*scores), others, "bound") is hopeless


def test_what_the_bound_is_measured_by():
    # A trial under way is no measure.
    others = [scored(0.9, 0.9)]
    assert is_hopeless(scored(0.1), others, "bound")
    assert not is_hopeless(scored(0.1), others, "bound", n_seeds=3)
    assert is_hopeless(scored(0.1), [*others, scored(0.8, 0.8, 0.8)], "bound", n_seeds=3)
    # Perfect is the highest score that any trial has had.
    best = scored(-110.0, -110.0)
    assert not is_hopeless(scored(-115.0), [best, scored(-100.0, -200.0)], "bound")
    assert is_hopeless(scored(-115.0), [best, scored(-108.0, -200.0)], "bound")
    # Where the optimum is known nothing less is.
    others = [scored(0.7, 0.7, 0.7)]
    assert is_hopeless(scored(0.6), others, "bound")
    assert not is_hopeless(scored(0.6), others, "bound", ceiling=1.0)
    assert is_hopeless(scored(0.05), others, "bound", ceiling=1.0)


def test_the_bound_holds_for_whatever_a_setting_is_judged_by():
    others = [scored(0.9, 0.9, 0.9), scored(1.0, 0.1)]
    # One failed seed of three sinks a mean, and no median.
    assert is_hopeless(scored(0.1), others, "bound")
    assert not is_hopeless(scored(0.1), others, "bound", statistics.median)
    assert is_hopeless(scored(0.1, 0.1), others, "bound", statistics.median)


def test_the_median_is_that_of_the_others_on_the_same_seeds():
    others = [scored(0.0, 1.0), scored(0.2, 0.6), scored(0.6, 0.6), scored(0.8, 0.8)]
    # Their means are 0.5, 0.4, 0.6 and 0.8, the median of which is 0.55.
    assert is_hopeless(scored(0.5, 0.5), others, "median")
    assert not is_hopeless(scored(0.6, 0.5), others, "median")
    # Nothing is concluded from one seed, from three others, or from other seeds.
    assert not is_hopeless(scored(0.0), others, "median")
    assert not is_hopeless(scored(0.0, 0.0), others[1:], "median")
    assert not is_hopeless(scored(0.0, 0.0, first=1), others, "median")


def test_the_best_third_goes_on_at_each_rung():
    others = [scored(0.1 * n) for n in range(1, 6)]
    # Of six, two go on.
    assert not is_hopeless(scored(0.45), others, "halving")
    assert is_hopeless(scored(0.35), others, "halving")
    # Two seeds are between the rungs.
    whole = [scored(*[0.1 * n] * 3) for n in range(1, 6)]
    assert not is_hopeless(scored(0.0, 0.0), whole, "halving")
    assert is_hopeless(scored(0.0, 0.0, 0.0), [*whole, scored(*[1.0] * 9)], "halving")


def test_a_signed_rank_test_needs_four_seeds():
    best = scored(*[1.0 - 0.01 * n for n in range(10)])
    worse = {seed: score - 0.1 * (seed + 1) for seed, score in best.items()}
    first = [
        seed
        for seed in range(1, 11)
        if is_hopeless(dict(list(worse.items())[:seed]), [best], "wilcoxon")
    ]
    # All of n differences on one side have a probability of 1 in 2^n: 1 in 16 is below 0.1.
    assert first[0] == 4


def test_a_paired_t_test_sees_a_steady_difference_at_two_seeds():
    best = scored(0.9, 0.2, 0.8)
    assert is_hopeless(scored(0.8, 0.1), [best], "racing")
    assert not is_hopeless(scored(0.8, 0.2), [best], "racing")
    assert not is_hopeless(scored(0.9, 0.2), [best], "racing")


def test_the_default_takes_ranks_from_ten_seeds_on():
    # A score of 10 has been seen: with that, any trial could still win.
    for n_seeds, hopeless in ((9, False), (10, True)):
        best, luckiest = scored(*[0.5] * n_seeds), scored(10.0)
        worse = scored(*[0.4, 0.39, 0.38, 0.37])
        assert not is_hopeless(worse, [best, luckiest], "bound")
        assert is_hopeless(worse, [best, luckiest], "auto") is hopeless


def test_an_unknown_pruner_is_one_line():
    with pytest.raises(UserError, match="'medain': did you mean 'median'"):
        is_hopeless(scored(1.0), [], "medain")
