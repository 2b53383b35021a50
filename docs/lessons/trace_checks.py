"""Looks at answers to the exercises on n steps and traces; see `checker`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from answer_faults import (
    RIGHT,
    TOLERANCE,
    Floats,
    answering,
    compared,
    fault_of_array,
    given_back,
    looked_ahead,
    number_from,
)

from rl_yardstick.mdp import TransitionModel


@answering
def check_return(target: Callable[..., float]) -> str:
    """Whether a function is the n-step return, by what each reward and the value count in it.

    Args:
        target: called with rewards, shape (n,), the discount, and the value of the state after.
    """

    def weights(n: int, discount: float) -> Floats:
        rows = np.eye(n + 1)
        return np.array([number_from(target, row[:n], discount, row[n]) for row in rows])

    if abs(number_from(target, np.zeros(3), 0.9, 0.0)) > TOLERANCE:
        return "Where all rewards and the value are 0 it has to be 0."
    for n in (3, 1, 5):
        counted = weights(n, 0.9)
        if abs(number_from(target, np.ones(n), 0.9, 1.0) - counted.sum()) > TOLERANCE:
            return "What one reward counts depends on the others, or on the value. It is a sum."
        said = fault_of_weights(counted, 0.9)
        if said:
            return f"With {n} step{'s' * (n > 1)}: {said}"
    return RIGHT


def fault_of_weights(weights: Floats, discount: float) -> str:
    """What is wrong with how much the rewards and the value count, or nothing."""
    n = len(weights) - 1
    powers = discount ** np.arange(n + 2.0)
    rewards, value = weights[:n], weights[n]
    mistakes = {
        "the first reward is discounted. It comes at once, and counts in full.": powers[1 : n + 1],
        "the rewards are not discounted, and later ones have to count less.": np.ones(n),
        "the last reward counts most. The discounts are the wrong way round.": powers[:n][::-1],
        "that is the mean of the rewards. A return is a sum.": np.full(n, 1 / n),
    }
    if np.abs(rewards - powers[:n]).max() > TOLERANCE:
        for said, other in mistakes.items():
            if np.abs(rewards - other).max() < TOLERANCE:
                return said
        worst = int(np.abs(rewards - powers[:n]).argmax())
        return f"reward {worst} (the first is 0) counts {rewards[worst]:.4g} times. How late is it?"
    if abs(value) < TOLERANCE:
        return "the value of the state after the last step does not count."
    if abs(value - powers[n]) > TOLERANCE:
        side = "little" if value > powers[n] else "much"
        return f"the value after the last step is discounted too {side}. How many steps is it away?"
    return ""


def check_lambda_targets(model: TransitionModel, decay: float, values: Floats, means: Any) -> str:
    """Whether numbers are the means of the lambda-return, undiscounted, where nothing is chosen.

    Args:
        model: a decision process of one action.
        decay: lambda, between 0 and 1.
        values: the estimates that the targets have in them, shape (S,).
        means: the answer, shape (S,).
    """
    wrong = fault_of_array(means, (model.n_states,), "one mean for each state")
    if wrong:
        return wrong
    found = np.asarray(means, dtype=float)

    def ahead(later: Floats) -> Floats:
        return looked_ahead(model, 1.0, later)[:, 0]

    def mixed(later: Floats) -> Floats:
        return ahead((1 - decay) * values + decay * later)

    mistakes = {
        "They look one step ahead only: that is lambda 0.": ahead(values),
        "No estimate is in them any more, as if lambda were 1.": ahead(found),
        "The weights have to sum up to 1. Is the factor before the powers missing?": (
            mixed((1 - decay) * found) / (1 - decay)
        ),
        "All weights are too small. Which power of lambda does a single step have?": (
            decay * mixed(found / decay)
        ),
    }
    said = compared(found, mixed(found), model.reachable, mistakes)
    off = np.abs(mixed(found) - found)[model.reachable].max()
    if said.startswith("The two sides") and off < 0.05 * np.abs(found).max():
        said += " They are near: perhaps the sum ends too early."
    return said


@answering
def check_replacing_trace(step: Callable[..., Any]) -> str:
    """Whether a function lets traces fade, and sets that of a visited state to 1.

    Args:
        step: called with the traces, shape (S,), the state, the discount and lambda.
    """
    before, state, discount, decay = np.array([0.2, 1.0, 3.0, 0.0]), 2, 0.9, 0.6
    after = given_back(step, before.copy(), state, discount, decay)
    wrong = fault_of_array(after, before.shape, "one trace for each state")
    if wrong:
        return wrong
    found, faded = np.asarray(after, dtype=float), discount * decay * before
    others = np.arange(len(before)) != state
    if np.abs(found - faded)[others].max() > TOLERANCE:
        return fault_of_fading(found[others], before[others], discount, decay)
    if abs(found[state] - faded[state] - 1) < TOLERANCE:
        return "That is the accumulating trace: this one must not depend on what it was before."
    if abs(found[state] - discount * decay) < TOLERANCE:
        return "The state that is visited now has faded already: in which order do you do it?"
    return RIGHT if abs(found[state] - 1) < TOLERANCE else "The visited state's trace is not 1."


def fault_of_fading(found: Floats, before: Floats, discount: float, decay: float) -> str:
    """What has become of the traces of states that are not visited."""
    if np.abs(found).max() < TOLERANCE:
        return "The other states are forgotten at once. They should fade."
    if np.abs(found - before).max() < TOLERANCE:
        return "The traces of the other states have to fade."
    if np.abs(found[before == 0]).max() > TOLERANCE:
        return "A state that was never visited has got a trace."
    for factor, missing in ((discount, "lambda"), (decay, "the discount")):
        if np.abs(found - factor * before).max() < TOLERANCE:
            return f"The traces of the other states do not fade enough: {missing} is missing."
    return "The traces of the other states do not fade by the right factor."


@answering
def check_trace_length(length: Callable[..., float]) -> str:
    """Whether a function gives the mean number of steps for which Q(lambda) keeps a trace.

    Args:
        length: called with epsilon and the number of actions.
    """
    for epsilon, n_actions in ((0.5, 4), (0.1, 4), (1.0, 2), (0.2, 3)):
        found = number_from(length, epsilon, n_actions)
        cut = epsilon * (n_actions - 1) / n_actions
        # One step for certain, and as many as before wherever the next action does not cut.
        if abs(found - (1 + (1 - cut) * found)) < TOLERANCE:
            continue
        if abs(found - (1 + (1 - epsilon) * found)) < TOLERANCE:
            return "A random action can be a best one too, and cuts nothing then."
        if abs(found - (1 - cut) * (1 + found)) < TOLERANCE:
            return "The step of the visit itself counts as well."
        if abs(found - (1 + cut * found)) < TOLERANCE:
            return "The wrong way round: actions that are not the best cut the trace."
        return f"For epsilon {epsilon:g} and {n_actions} actions: how probable is a cut at a step?"
    return RIGHT
