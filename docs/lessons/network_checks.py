"""Looks at answers to the exercises on DQN; see `checker`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from answer_faults import (
    RIGHT,
    TOLERANCE,
    AnswerError,
    Floats,
    answering,
    fault_of_array,
    given_back,
    number_from,
)

REWARDS = np.random.default_rng(0).normal(size=12)
TERMINATED = np.arange(12) % 3 == 1
DISCOUNT, STEP = 0.9, 1e-3


def targets_from(function: Callable[..., Any], *arguments: Any) -> Floats:
    """What a function gives for the minibatch.

    Raises:
        AnswerError: if it cannot be called, or gives no array of one number for each step.
    """
    given = given_back(function, REWARDS.copy(), TERMINATED.copy(), *arguments)
    wrong = fault_of_array(given, REWARDS.shape, "one target for each step")
    if wrong:
        raise AnswerError(wrong)
    return np.asarray(given, dtype=float)


def slopes_of(told: Callable[[Floats], Floats], values: Floats) -> Floats:
    """How much each target moves with each value, shape (n, n, A): target, row, column."""
    base, slopes = told(values), np.zeros((len(REWARDS), *values.shape))
    for row, column in np.ndindex(*values.shape):
        moved = values.copy()
        moved[row, column] += STEP
        slopes[:, row, column] = (told(moved) - base) / STEP
    return slopes


def fault_of_ends(told: Callable[[float], Floats], usual: float = DISCOUNT) -> str:
    """What is wrong at ends of episodes, or if nothing that follows counts; empty if nothing is."""
    if np.abs(told(usual) - REWARDS)[TERMINATED].max() > TOLERANCE:
        going_on = np.abs(told(usual) - REWARDS)[~TERMINATED].max() < TOLERANCE
        return (
            "It is the wrong way round: what follows counts just where the episode has ended."
            if going_on
            else "When the episode has terminated nothing follows: the target is the reward alone."
        )
    if np.abs(told(0.0) - REWARDS).max() > TOLERANCE:
        return "With a discount of 0 only the reward should count."
    return ""


def fault_of_rows(slopes: Floats) -> str:
    """Whether a target depends on the values of another step; empty if not."""
    others = ~np.eye(len(REWARDS), dtype=bool)
    if np.abs(slopes[others]).max() > TOLERANCE:
        return (
            "A target has to depend on the values of its own next state alone, and yours depends "
            "on those of other steps: along which axis is the largest value taken?"
        )
    return ""


def own_slopes(slopes: Floats) -> Floats:
    """How much each target of a step that goes on moves with the values of its own row."""
    steps = np.flatnonzero(~TERMINATED)
    return slopes[steps, steps]


@answering
def check_targets(targets: Callable[..., Any]) -> str:
    """Whether a function gives DQN's targets, tried on a minibatch.

    Args:
        targets: called with rewards, shape (n,), terminated, (n,), the target network's values of
            the next states, (n, A), and the discount.
    """
    values = np.random.default_rng(0).normal(size=(len(REWARDS), 3))
    slopes = slopes_of(lambda tried: targets_from(targets, tried, DISCOUNT), values)
    said = fault_of_rows(slopes) or fault_of_ends(
        lambda discount: targets_from(targets, values, discount)
    )
    if said:
        return said
    own, best = own_slopes(slopes), values[~TERMINATED].argmax(axis=1)
    counted = own[np.arange(len(own)), best]
    if np.ptp(own) < TOLERANCE < own.max():
        return "All next actions count alike. DQN supposes that the best one follows."
    if np.abs(counted - DISCOUNT).max() > 1e-6:
        return (
            "If the best next value rises by 1, the target has to rise by the discount, here 0.9; "
            f"yours rises by {counted[np.abs(counted - DISCOUNT).argmax()]:.4g}."
        )
    others = own.sum(axis=1) - counted
    return (
        RIGHT if np.abs(others).max() < 1e-6 else "Values of actions count that are not the best."
    )


@answering
def check_double_targets(targets: Callable[..., Any]) -> str:
    """Whether a function gives double DQN's targets, tried on a minibatch.

    Args:
        targets: called with rewards, shape (n,), terminated, (n,), the learning network's values of
            the next states, (n, A), the target network's, (n, A), and the discount.
    """
    rng = np.random.default_rng(1)
    online, lagging = rng.normal(size=(2, len(REWARDS), 3))
    lagging -= 2 * np.eye(3)[online.argmax(axis=1)]  # no step is judged alike by both

    def told(
        learning: Floats = online, target: Floats = lagging, discount: float = DISCOUNT
    ) -> Floats:
        return targets_from(targets, learning, target, discount)

    by_online = slopes_of(lambda tried: told(learning=tried), online)
    by_lagging = slopes_of(lambda tried: told(target=tried), lagging)
    said = (
        fault_of_rows(by_online)
        or fault_of_rows(by_lagging)
        or fault_of_ends(lambda discount: told(discount=discount))
    )
    return said or fault_of_roles(online, lagging, own_slopes(by_online), own_slopes(by_lagging))


def fault_of_roles(online: Floats, lagging: Floats, by_online: Floats, by_lagging: Floats) -> str:
    """What each network is used for, and should not be."""
    steps = np.arange(len(by_online))
    chosen = online[~TERMINATED].argmax(axis=1)
    largest = lagging[~TERMINATED].argmax(axis=1)
    if np.abs(by_online).max() > TOLERANCE and np.abs(by_lagging).max() > TOLERANCE:
        return (
            "The values of both networks count. Only one of them is to say what an action is worth."
        )
    if np.abs(by_online).max() > TOLERANCE:
        alone = np.abs(by_online[steps, chosen] - DISCOUNT).max() < 1e-6
        return (
            "The target network has no part in it: that is Q-learning with one network."
            if alone
            else "The roles are the wrong way round: which network chooses, and which one judges?"
        )
    if np.abs(by_lagging[steps, largest] - DISCOUNT).max() < 1e-6:
        return "The target network chooses and judges. That is DQN without the second opinion."
    expected = np.zeros_like(by_lagging)
    expected[steps, chosen] = DISCOUNT
    if np.abs(by_lagging - expected).max() < 1e-6:
        return RIGHT
    return "It is not the discounted value of the chosen action by the target network."


@answering
def check_loss(loss: Callable[..., float]) -> str:
    """Whether a function is Huber's loss, by its slope.

    Args:
        loss: called with an error.
    """

    def told(error: float) -> float:
        return number_from(loss, error)

    def slope(error: float) -> float:
        return (told(error + 1e-5) - told(error - 1e-5)) / 2e-5

    if abs(told(0.0)) > TOLERANCE:
        return "Without an error there is no loss."
    if any(told(error) < 0 for error in (-3.0, -0.5, 0.5, 3.0)):
        return "A loss is never below 0."
    if abs(told(1.7) - told(-1.7)) > TOLERANCE or abs(told(0.5) - told(-0.5)) > TOLERANCE:
        return "An error above and one below have to count alike."
    if max(abs(slope(error) - error) for error in (0.3, 0.9)) > 1e-4:
        return "Between -1 and 1 it has to be half the square of the error."
    if abs(slope(4.0) - slope(2.0)) > 1e-4:
        return "Beyond 1 it has to be a straight line: twice as far must not be steeper."
    if abs(told(1 + 1e-7) - told(1 - 1e-7)) > 1e-4:
        return "It jumps where the two parts meet. The line has to go on where the square ends."
    if abs(slope(2.0) - slope(1 - 1e-4)) > 1e-3:
        return "It bends where the two parts meet: how steep is the half square at 1?"
    return RIGHT
