"""The checks of the lesson on DQN: right answers pass, and each common mistake is named."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

# A lesson imports it as a script in its folder does.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "lessons"))
checks = importlib.import_module("network_checks")


def targets(rewards, terminated, values, discount, follows=lambda values: values.max(axis=1)):
    return rewards + discount * ~terminated * follows(values)


ROWS = "A target has to depend on the values of its own next state alone"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (targets, "Right."),
        (lambda *_: ..., "Not done yet: the function"),
        (lambda rewards: rewards, "It fails when it is called"),
        (lambda r, t, v, d: (r + d * v.T).T, "The shape has to be (12,), one target for each step"),
        (lambda r, t, v, d: r[:, None] + d * v.max(axis=1), "The shape has to be (12,), one targ"),
        (lambda r, t, v, d: r + d * v.max(axis=0), "It fails when it is called: operands"),
        (lambda r, t, v, d: r + d * v.max(), ROWS),
        (lambda r, t, v, d: r + d * v.max(axis=1), "When the episode has terminated nothing"),
        (lambda r, t, v, d: r + d * t * v.max(axis=1), "It is the wrong way round"),
        (lambda r, t, v, d: targets(r, t, v, 1), "With a discount of 0 only the reward"),
        (lambda r, t, v, d: r * d + ~t * v.max(axis=1), "When the episode has terminated"),
        (lambda r, t, v, d: r, "If the best next value rises by 1"),
        (lambda r, t, v, d: targets(r, t, v, d, lambda v: v[:, 0]), "If the best next value rises"),
        (lambda r, t, v, d: targets(r, t, v, d, lambda v: v.min(axis=1)), "If the best next value"),
        (
            lambda r, t, v, d: targets(r, t, v, d, lambda v: v.mean(axis=1)),
            "All next actions count",
        ),
        (
            lambda r, t, v, d: targets(r, t, v, d, lambda v: v.max(axis=1) + v.min(axis=1)),
            "Values of actions count that are not the best.",
        ),
    ],
)
def test_targets_of_a_minibatch(answer, said):
    assert checks.check_targets(answer).startswith(said)


def doubled(choosing, judging):
    """Targets that choose by one array of values and judge by another."""

    def told(rewards, terminated, online, lagging, discount):
        chosen = choosing(online, lagging).argmax(axis=1)
        values = judging(online, lagging)[np.arange(len(chosen)), chosen]
        return rewards + discount * ~terminated * values

    return told


def online(first, second):
    return first


def lagging(first, second):
    return second


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (doubled(online, lagging), "Right."),
        (lambda *_: None, "Not done yet: the function"),
        (doubled(lagging, online), "The roles are the wrong way round"),
        (doubled(lagging, lagging), "The target network chooses and judges."),
        (doubled(online, online), "The target network has no part in it"),
        (doubled(np.minimum, np.minimum), "The values of both networks count."),
        (doubled(online, np.add), "The values of both networks count. Only one"),
        (doubled(np.add, lagging), "It is not the discounted value of the chosen action"),
        (lambda r, t, a, b, d: r + d * b[:, a.argmax(axis=1)][0], ROWS),
        (lambda r, t, a, b, d: r + d * b.max(axis=1), "When the episode has terminated"),
        (lambda r, t, a, b, d: doubled(online, lagging)(r, t, a, b, 1.0), "With a discount of 0"),
        (lambda r, t, a, b, d: doubled(online, lagging)(r, t, a, b, d * d), "It is not the disc"),
    ],
)
def test_double_targets(answer, said):
    assert checks.check_double_targets(answer).startswith(said)


def huber(error):
    return error**2 / 2 if abs(error) < 1 else abs(error) - 0.5


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (huber, "Right."),
        (lambda error: None, "Not done yet"),
        (lambda error: huber(error) + 1, "Without an error there is no loss."),
        (lambda error: error, "A loss is never below 0."),
        (lambda error: error**2 / 2 if error < 1 else error - 0.5, "An error above and one below"),
        (abs, "Between -1 and 1 it has to be half the square"),
        (lambda error: error**2, "Between -1 and 1 it has to be half the"),
        (lambda error: error**2 / 2, "Beyond 1 it has to be a straight line"),
        (lambda error: error**2 / 2 if abs(error) < 1 else abs(error), "It jumps where"),
        (lambda error: error**2 / 2 if abs(error) < 1 else 0.5, "It bends where"),
        (lambda error: error**2 / 2 if abs(error) < 1 else 2 * abs(error) - 1.5, "It bends whe"),
    ],
)
def test_losses(answer, said):
    assert checks.check_loss(answer).startswith(said)
