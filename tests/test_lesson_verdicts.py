"""The checks of the lesson on PPO and on figures over seeds: mistakes are named."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

# A lesson imports it as a script in its folder does.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "lessons"))
checks = importlib.import_module("verdict_checks")


def score(earned, optimum, baseline):
    return (earned - baseline) / (optimum - baseline)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (score, "Right."),
        (lambda *_: None, "Not done yet"),
        (lambda earned: earned, "It fails when it is called"),
        (lambda earned, best, nothing: 1 // 0, "It fails when it is called: integer"),
        (lambda earned, best, nothing: best - earned, "The optimum has the score 0"),
        (lambda earned, best, nothing: 1 - score(earned, best, nothing), "The optimum has the sco"),
        (lambda earned, best, nothing: earned / best, "The baseline has to have the score 0"),
        (lambda earned, best, nothing: (earned - nothing) / best, "The optimum has to have the sc"),
        (lambda *given: max(score(*given), 0), "Who is worse than the baseline"),
        (lambda *given: abs(score(*given)), "Who is worse than the"),
        (lambda *given: score(*given) ** 3, "In the middle between baseline and optimum"),
        (lambda earned, *_: (earned + 20) / 100, "It is right for one optimum"),
    ],
)
def test_scores(answer, said):
    assert checks.check_score(answer).startswith(said)


def gain(ratio, advantage, epsilon):
    bounded = min(max(ratio, 1 - epsilon), 1 + epsilon)
    return min(ratio * advantage, bounded * advantage)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (gain, "Right."),
        (lambda *_: ..., "Not done yet"),
        (lambda ratio, advantage, epsilon: ratio, "Where new and old probability are equal"),
        (lambda *given: -gain(*given), "Where new and old probability are"),
        (
            lambda ratio, a, epsilon: a * (1 if a > 0 else ratio),
            "Within the bounds the gain is the ratio times the advantage.",
        ),
        (
            lambda ratio, a, epsilon: a * (ratio if a > 0 else 1),
            "Within the bounds the gain is the ratio times the advantage, below 0",
        ),
        (lambda ratio, advantage, epsilon: ratio * advantage, "Nothing is bounded"),
        (
            lambda ratio, a, epsilon: max(ratio * a, np.clip(ratio, 1 - epsilon, 1 + epsilon) * a),
            "A good action (advantage above 0) must gain no more",
        ),
        (
            lambda ratio, a, epsilon: np.clip(ratio, 1 - epsilon, 1 + epsilon) * a,
            "A good action that has become much less probable",
        ),
        (
            lambda ratio, a, epsilon: min(ratio, 1 + epsilon) * a,
            "A bad action (advantage below 0) that has become much more probable",
        ),
        (
            lambda ratio, a, epsilon: gain(ratio, a, epsilon) if a > 0 else ratio * a,
            "A bad action must gain no more",
        ),
        (lambda ratio, a, epsilon: gain(ratio, a, 0.2), "Epsilon is not always 0.2."),
    ],
)
def test_gains(answer, said):
    assert checks.check_gain(answer).startswith(said)


def wins(first, second):
    return ((first[:, None] > second) + (first[:, None] == second) / 2).mean()


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (wins, "Right."),
        (lambda *_: None, "Not done yet"),
        (lambda first, second: np.sum(first[:, None] > second), "A share lies between 0 and 1"),
        (lambda first, second: np.mean(first > second), "It depends on the order of the seeds."),
        (lambda first, second: np.mean(first[:, None] > second), "Two agents that always tie win"),
        (lambda first, second: np.mean(first[:, None] >= second), "Two agents that always tie"),
        (lambda first, second: wins(second, first), "It is the share that the second agent wins."),
        (
            lambda first, second: wins(first, second) if second[0] else 0.4,
            "What the first wins the second loses",
        ),
        (
            lambda first, second: 0.5 + np.clip(first.mean() - second.mean(), -5, 5) / 10,
            "How far a run is ahead must not count",
        ),
        (
            lambda first, second: 0.5 + np.sign(np.median(first) - np.median(second)) / 2,
            "Three runs against three are nine pairs",
        ),
        (
            lambda first, second: wins(first[: len(second)], second[: len(first)]),
            "It is right where both have the same number",
        ),
    ],
)
def test_shares_of_pairs(answer, said):
    assert checks.check_wins(answer).startswith(said)
