"""Checks of arguments: a ValueError names in one line the argument, and what it may be."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence

import numpy as np

from rl_yardstick.mdp.transition_model import Floats


def check_number(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """The value as a float, if it is a finite number between two others, both included."""
    if isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool):
        number = float(value)
        if math.isfinite(number) and low <= number <= high:
            return number
    between = f" from {low} to {high}" if math.isfinite(high) else ""
    raise ValueError(f"{name} must be a finite number{between}, not {value!r}")


def check_whole_number(name: str, value: object, low: int, high: int) -> int:
    """The value as an int, if it is a whole number between two others, both included."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool) and low <= value <= high:
        return int(value)
    raise ValueError(f"{name} must be a whole number from {low} to {high}, not {value!r}")


def check_choice(name: str, value: object, choices: Sequence[str]) -> str:
    """The value, if it is one of the choices."""
    if isinstance(value, str) and value in choices:
        return value
    near = difflib.get_close_matches(str(value), choices, n=1)
    hint = f"did you mean {near[0]!r}? It" if near else "it"
    raise ValueError(f"unknown {name} {value!r}: {hint} must be one of {', '.join(choices)}")


def check_flag(name: str, value: object) -> bool:
    """The value, if it is true or false; a number is neither."""
    if isinstance(value, bool):
        return value
    raise ValueError(f"{name} must be true or false, not {value!r}")


def check_numbers(
    name: str, values: object, low: float = -math.inf, high: float = math.inf, fewest: int = 2
) -> tuple[float, ...]:
    """The values as floats, if they are a list of finite numbers as `check_number` takes them."""
    if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray):
        raise ValueError(f"{name} must be a list of numbers, not {values!r}")
    if len(values) < fewest:
        raise ValueError(f"{name} must hold {fewest} numbers or more, not {len(values)}")
    return tuple(check_number(f"{name}[{i}]", value, low, high) for i, value in enumerate(values))


def check_table(name: str, rows: object, low: float = -math.inf, high: float = math.inf) -> Floats:
    """Rows of numbers, all as long as the first, as an array of shape (rows, columns)."""
    if isinstance(rows, str) or not isinstance(rows, Sequence | np.ndarray) or not len(rows):
        raise ValueError(f"{name} must be a list of rows of numbers, not {rows!r}")
    checked = [check_numbers(f"{name}[{i}]", row, low, high, 1) for i, row in enumerate(rows)]
    for i, row in enumerate(checked):
        if len(row) != len(checked[0]):
            raise ValueError(f"{name}[{i}] has length {len(row)}, {name}[0] has {len(checked[0])}")
    return np.array(checked)
