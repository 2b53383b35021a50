"""What is wrong with an array, and how it stands to an equation that it has to solve."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.mdp import TransitionModel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
RIGHT = "Right."
TOLERANCE = 1e-6


def probabilities(model: TransitionModel, policy: Any) -> Floats:
    """A policy as probabilities, shape (S, A)."""
    given = np.asarray(policy)
    return np.eye(model.n_actions)[given.astype(int)] if given.ndim == 1 else given


def looked_ahead(
    model: TransitionModel, discount: float, values: Floats, *, endless: bool = False
) -> Floats:
    """The reward and the discounted value of what follows, for each state and action, (S, A)."""
    following = values[model.next_state]
    if not endless:
        following = np.where(model.terminated, 0.0, following)
    result: Floats = (model.prob * (model.reward + discount * following)).sum(axis=2)
    return result


def fault_of_array(answer: Any, shape: tuple[int, ...], what: str) -> str:
    """Why an answer is no array of numbers of that shape; empty where it is one."""
    if answer is None or answer is Ellipsis:
        return "Not done yet."
    try:
        numbers = np.asarray(answer, dtype=float)
    except (TypeError, ValueError):
        return f"It has to be an array of numbers, {what}."
    if numbers.shape != shape:
        return f"The shape has to be {shape}, {what}; it is {numbers.shape}."
    return "" if np.isfinite(numbers).all() else "There are numbers in it that are not finite."


def compared(
    found: Floats, ahead: Floats, states: NDArray[np.bool_], mistakes: dict[str, Floats]
) -> str:
    """Say whether an answer agrees with what one step ahead makes of it, or with which mistake."""
    scale = max(1.0, float(np.abs(found).max()))
    off = np.where(states if found.ndim == 1 else states[:, None], np.abs(ahead - found), 0.0)
    if off.max() <= TOLERANCE * scale:
        return RIGHT
    for said, other in mistakes.items():
        if np.abs(other - found)[states].max() <= TOLERANCE * scale:
            return said
    worst = np.unravel_index(int(off.argmax()), off.shape)
    place = f"state {worst[0]}" + (f", action {worst[1]}" if found.ndim == 2 else "")
    side = "higher" if found[worst] > ahead[worst] else "lower"
    return (
        "The two sides of the equation differ at "
        f"{(off > TOLERANCE * scale).sum()} of {off.size} places, "
        f"most in {place}: yours is {side} than what one step ahead makes of it."
    )


class AnswerError(Exception):
    """A function that is an answer cannot be tried; the text says why."""


def answering(check: Callable[..., str]) -> Callable[..., str]:
    """Let a check say what an `AnswerError` says."""

    @wraps(check)
    def checked(*arguments: Any, **more: Any) -> str:
        try:
            return check(*arguments, **more)
        except AnswerError as fault:
            return str(fault)

    return checked


def given_back(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function that is an answer gives.

    Raises:
        AnswerError: if it cannot be called so, or gives nothing.
    """
    try:
        given = function(*arguments)
    except (TypeError, ValueError, IndexError, ArithmeticError) as fault:
        raise AnswerError(f"It fails when it is called: {fault}") from None
    if given is None or given is Ellipsis:
        raise AnswerError("Not done yet: the function gives nothing back.")
    return given


def number_from(function: Callable[..., Any], *arguments: Any) -> float:
    """What a function that is an answer gives, as a finite number.

    Raises:
        AnswerError: if it cannot be called so, or gives something else.
    """
    given = given_back(function, *arguments)
    try:
        number = float(given)
    except (TypeError, ValueError) as fault:
        raise AnswerError(f"It has to give a number: {fault}") from None
    if not np.isfinite(number):
        raise AnswerError(f"It gives {number}, which is not finite.")
    return number
