"""Trials are ended early when they are hopeless, and not before."""

import statistics

import pytest

from pipeline.errors import UserError
from tuning.pruning import PRUNERS, is_hopeless


def scored(scores, first=0):
    return {first + number: score for number, score in enumerate(scores)}


@pytest.mark.parametrize("method", PRUNERS)
def test_the_first_trial_and_the_best_one_go_on_and_the_worst_of_many_does_not(method):
    assert not is_hopeless({}, [], method)
    assert not is_hopeless(scored([0.1, 0.1]), [], method)
    others = [scored([0.1 * n] * 12) for n in range(8)]
    assert not any(is_hopeless(scored([0.8] * n), others, method) for n in range(1, 12))
    better = [scored([0.5 + 0.05 * n] * 12) for n in range(8)]
    ended = [is_hopeless(scored([0.0] * n), better, method) for n in range(1, 12)]
    assert any(ended) is (method != "none")


TWO = [[0.9, 0.9, 1.0], [1.0, 0.2]]
FAILED = [[0.9, 0.9, 0.9], [1.0, 0.1]]
SHORT, LONG = [[0.9, 0.9]], [[0.9, 0.9], [0.8, 0.8, 0.8]]
# Their means are 0.5, 0.4, 0.6 and 0.8, the median of which is 0.55.
FOUR = [[0.0, 1.0], [0.2, 0.6], [0.6, 0.6], [0.8, 0.8]]
FIVE = [[0.1 * n] for n in range(1, 6)]
WHOLE = [[0.1 * n] * 3 for n in range(1, 6)]
# A score of 10 has been seen: with that, any trial could still win.
NINE, TEN = ([[0.5] * n, [10.0]] for n in (9, 10))
WORSE = [0.4, 0.39, 0.38, 0.37]
RACE = [[0.9, 0.2, 0.8]]


@pytest.mark.parametrize(
    ("method", "scores", "others", "options", "hopeless"),
    [
        # What is left counts as perfect: 0.9 and twice 1.0 is more than 2.8, with 0.8 it is a draw.
        ("bound", [0.9], TWO, {}, False),
        ("bound", [0.8], TWO, {}, False),
        ("bound", [0.79], TWO, {}, True),
        ("bound", [1.0, 0.79], TWO, {}, True),
        ("bound", [1.0, 1.0, 0.1], TWO, {}, False),  # nothing is left to save
        # A trial under way is no measure.
        ("bound", [0.1], SHORT, {}, True),
        ("bound", [0.1], SHORT, {"n_seeds": 3}, False),
        ("bound", [0.1], LONG, {"n_seeds": 3}, True),
        # Perfect is the highest score that any trial has had.
        ("bound", [-115.0], [[-110.0, -110.0], [-100.0, -200.0]], {}, False),
        ("bound", [-115.0], [[-110.0, -110.0], [-108.0, -200.0]], {}, True),
        # Where the optimum is known nothing less is.
        ("bound", [0.6], [[0.7, 0.7, 0.7]], {}, True),
        ("bound", [0.6], [[0.7, 0.7, 0.7]], {"ceiling": 1.0}, False),
        ("bound", [0.05], [[0.7, 0.7, 0.7]], {"ceiling": 1.0}, True),
        # One failed seed of three sinks a mean, and no median.
        ("bound", [0.1], FAILED, {}, True),
        ("bound", [0.1], FAILED, {"value": statistics.median}, False),
        ("bound", [0.1, 0.1], FAILED, {"value": statistics.median}, True),
        # Nothing is concluded from one seed, or from three others.
        ("median", [0.5, 0.5], FOUR, {}, True),
        ("median", [0.6, 0.5], FOUR, {}, False),
        ("median", [0.0], FOUR, {}, False),
        ("median", [0.0, 0.0], FOUR[1:], {}, False),
        # Of six, two go on; two seeds are between the rungs.
        ("halving", [0.45], FIVE, {}, False),
        ("halving", [0.35], FIVE, {}, True),
        ("halving", [0.0, 0.0], WHOLE, {}, False),
        ("halving", [0.0, 0.0, 0.0], [*WHOLE, [1.0] * 9], {}, True),
        # A paired t test sees a steady difference at two seeds.
        ("racing", [0.8, 0.1], RACE, {}, True),
        ("racing", [0.8, 0.2], RACE, {}, False),
        ("racing", [0.9, 0.2], RACE, {}, False),
        # The default takes ranks from ten seeds on.
        ("auto", WORSE, NINE, {}, False),
        ("auto", WORSE, TEN, {}, True),
        ("bound", WORSE, TEN, {}, False),
    ],
)
def test_what_is_hopeless(method, scores, others, options, hopeless):
    found = is_hopeless(scored(scores), [scored(each) for each in others], method, **options)
    assert found is hopeless


def test_trials_are_compared_on_the_same_seeds():
    assert not is_hopeless(scored([0.0, 0.0], first=1), [scored(each) for each in FOUR], "median")


def test_a_signed_rank_test_needs_four_seeds():
    best = scored([1.0 - 0.01 * n for n in range(10)])
    worse = [score - 0.1 * (seed + 1) for seed, score in best.items()]
    ended = [is_hopeless(scored(worse[:n]), [best], "wilcoxon") for n in range(1, 11)]
    # All of n differences on one side have a probability of 1 in 2^n: 1 in 16 is below 0.1.
    assert ended.index(True) + 1 == 4


def test_an_unknown_pruner_is_one_line():
    with pytest.raises(UserError, match="'medain': did you mean 'median'"):
        is_hopeless(scored([1.0]), [], "medain")
