"""The checks of the lesson on exploration: right answers pass, and each common mistake is named."""

import importlib
import math
import sys
from pathlib import Path

import pytest
from scipy import special

# A lesson imports it as a script in its folder does.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "lessons"))
checks = importlib.import_module("exploration_checks")


def divergence(p, q):
    return special.rel_entr(p, q) + special.rel_entr(1 - p, 1 - q)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (divergence, "Right."),
        (lambda p, q: None, "Not done yet"),
        (lambda p: p, "It fails when it is called"),
        (lambda p, q: p / (q - q), "It fails when it is called: float division"),
        (lambda p, q: math.inf, "It gives inf"),
        (lambda p, q: [p, q], "It has to give a number"),
        (lambda p, q: -p * math.log(q), "For two equal probabilities it has to be 0"),
        (lambda p, q: -divergence(p, q), "It has to be above 0 wherever p and q differ"),
        (lambda p, q: p * math.log(p / q), "It falls below 0. A pull can pay 1"),
        (lambda p, q: abs(p * math.log(p / q)), "Call a success a failure"),
        (lambda p, q: divergence(p, q) / math.log(2), "The form is right, but"),
        (lambda p, q: divergence(q, p), "The two are the wrong way round"),
        (lambda p, q: 2 * (p - q) ** 2, "It is 0 where it has to be"),
    ],
)
def test_divergences(answer, said):
    assert checks.check_divergence(answer).startswith(said)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda size, epsilon: (2 / epsilon) ** size, "Right."),
        (lambda size, epsilon: ..., "Not done yet"),
        (lambda size, epsilon: (epsilon / 2) ** size, "That is the chance that one episode"),
        (lambda size, epsilon: (2 / epsilon) ** (size - 1), "There is one move too few"),
        (lambda size, epsilon: (2 / epsilon) ** size - 1, "Those before the first success"),
        (lambda size, epsilon: math.log(2) * (2 / epsilon) ** size, "Half of all divers"),
        (lambda size, epsilon: (1 / epsilon) ** size, "A random action is the right one in half"),
        (lambda size, epsilon: 2**size, "Epsilon is missing"),
        (lambda size, epsilon: (1 - epsilon / 2) ** -size, "This diver would take the right"),
        (lambda size, epsilon: 2 * size / epsilon, "For 5 rows and epsilon 0.1 it is too low."),
        (lambda size, epsilon: 10.0**9, "For 3 rows and epsilon 1 it is too high."),
        (lambda size, epsilon: -1, "For 5 rows and epsilon 0.1 it is too"),
    ],
)
def test_episodes_until_the_treasure(answer, said):
    assert checks.check_episodes(answer).startswith(said)


def bonus_target(bonus, *, at_the_end=True, discounted=False):
    """Q-learning's target and a bonus."""

    def target(reward, discount, terminated, next_values, count, scale):
        added = bonus(count, scale) * (discount if discounted else 1)
        if terminated:
            return reward + added * at_the_end
        return reward + added + discount * next_values.max()

    return target


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (bonus_target(lambda count, scale: scale / math.sqrt(count)), "Right."),
        (lambda *_: None, "Not done yet"),
        (lambda reward, *_: reward, "With a scale of 0 it should be the target of Q-learning. If"),
        (
            bonus_target(lambda count, scale: 1 / math.sqrt(count)),
            "With a scale of 0 it should be the target of Q-learning. When the episode",
        ),
        (
            bonus_target(lambda count, scale: scale / math.sqrt(count), at_the_end=False),
            "There is no bonus at the end",
        ),
        (
            bonus_target(lambda count, scale: scale / math.sqrt(count), discounted=True),
            "The bonus depends on the discount",
        ),
        (bonus_target(lambda count, scale: scale * math.sqrt(count)), "What was tried less often"),
        (bonus_target(lambda count, scale: 0.0), "What was tried less"),
        (bonus_target(lambda count, scale: -scale / math.sqrt(count)), "What was tried"),
        (bonus_target(lambda count, scale: scale**2 / math.sqrt(count)), "If the scale is twice"),
        (bonus_target(lambda count, scale: scale / count), "The bonus falls too fast"),
        (bonus_target(lambda count, scale: scale / (1 + count)), "With four times as many visits"),
        (bonus_target(lambda count, scale: 2 * scale / math.sqrt(count)), "The form is right, but"),
    ],
)
def test_targets_with_a_bonus(answer, said):
    assert checks.check_bonus_target(answer).startswith(said)
