"""What flags take: whole numbers, numbers and names, each misfit in one line."""

from __future__ import annotations

import argparse
import decimal
import math
from collections.abc import Callable, Mapping
from decimal import Decimal
from typing import TypeVar

from experiments import run_limits
from pipeline.errors import shown
from pipeline.files import portable_name
from pipeline.unfinished_runs import SaveInterval

LARGEST = 10**12
Amount = TypeVar("Amount", int, float)
LONGEST_FOLDER_NAME = 200  # bytes
_NO_FOLDER_NAME = {"", ".", ".."}
_NOT_IN_FOLDER_NAMES = set("/\\\0\n")


def whole_number(
    least: int, most: int = LARGEST, besides: Mapping[int, str] | None = None
) -> Callable[[str], int]:
    """A reader of whole numbers: ``100000``, ``100_000`` or ``1e5``.

    Args:
        least: the smallest.
        most: the largest.
        besides: further numbers, and what each of them stands for.

    Returns:
        A function of the text that a flag is given, for argparse. It raises `ArgumentTypeError`.
    """
    meanings = besides or {}

    def read(text: str) -> int:
        number = _whole(text)
        if number is not None and (least <= number <= most or number in meanings):
            return number
        bounds = f" of at least {least:,}" if least > -LARGEST else ""
        if number is not None and number > most:
            bounds = f" of at most {most:,}"
        others = "".join(f", or {key} ({meaning})" for key, meaning in meanings.items())
        raise argparse.ArgumentTypeError(f"must be a whole number{bounds}{others}, not {text!r}")

    return read


def _whole(text: str) -> int | None:
    """The number, cut off beyond anything that a flag takes; None where it is no whole one."""
    try:
        # Exact, where the detour by way of a float would not be.
        number = Decimal(text)
    except decimal.InvalidOperation:
        return None
    if not number.is_finite():
        return None
    # Before it is made an int: 1e999999999 has a billion digits.
    if number > LARGEST:
        return LARGEST + 1
    if number < -LARGEST:
        return -LARGEST - 1
    return int(number) if number == number.to_integral_value() else None


def number_at_least_zero(text: str) -> float:
    """A finite number that is not below 0.

    Raises:
        argparse.ArgumentTypeError: for any other text.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number of at least 0, not {text!r}")
    return number


def quantity(read: Callable[[str], Amount]) -> Callable[[str], Amount]:
    """A reader of amounts with units, of one that raises ValueError; for argparse."""

    def read_flag(text: str) -> Amount:
        try:
            return read(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read_flag


def filled(text: str) -> str:
    """A text that is not empty.

    Raises:
        argparse.ArgumentTypeError: if it is.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def folder_name(text: str) -> str:
    """The name of one folder.

    Raises:
        argparse.ArgumentTypeError: if the text leads elsewhere.
    """
    if text.strip() in _NO_FOLDER_NAME or not _NOT_IN_FOLDER_NAMES.isdisjoint(text):
        raise argparse.ArgumentTypeError(f"must be the name of one folder, not {shown(text)}")
    if portable_name(text, LONGEST_FOLDER_NAME) != text:
        raise argparse.ArgumentTypeError(
            f"must be a name that every system takes, not {shown(text)}"
        )
    return text


_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def save_interval(text: str) -> SaveInterval:
    """How often to save a state: ``30s``, ``5m``, ``5000`` steps, ``auto`` or ``never``.

    Raises:
        argparse.ArgumentTypeError: for any other text.
    """
    if text in ("auto", "never"):
        return SaveInterval(is_off=text == "never")
    number, unit = (text[:-1], text[-1]) if text[-1:] in _UNITS else (text, "")
    if unit:
        try:
            seconds = float(number) * _UNITS[unit]
        except ValueError:
            seconds = math.nan
        if 0 < seconds < math.inf:
            return SaveInterval(seconds=seconds)
    elif (steps := _whole(text)) is not None and 1 <= steps <= LARGEST:
        return SaveInterval(steps=steps)
    raise argparse.ArgumentTypeError(
        f"must be seconds as 30s, minutes as 5m, steps as 5000, auto or never, not {shown(text)}"
    )


ENGINES = ("auto", "compiled", "library", "interpreted")


def add_engine_flag(group: argparse._ActionsContainer) -> None:
    """The flag that says what trainings run on, the same for every command that has any."""
    group.add_argument(
        "--engine",
        choices=ENGINES,
        help="what trains: auto (compiled code where that is possible and the budget is worth it), "
        "compiled, library (Stable-Baselines3's own loop; the default of dqn, ppo and a2c), or for "
        "tables interpreted; the default of all others is auto",
    )


COUNT = whole_number(1)
COUNT_OR_NONE = whole_number(0)
# As rl_zoo3 has it: -1 stands for what the hyperparameters say.
BUDGET = whole_number(1, besides={-1: "what the hyperparameters say"})
# As rl_zoo3 has it: below 1 for never.
INTERVAL = whole_number(-LARGEST)
LOG_INTERVAL = whole_number(1, besides={-1: "the library's default", -2: "no log"})
# The library hands seeds to NumPy's global generator, which takes 32 bits.
SEED = whole_number(0, 2**32 - 1, besides={-1: "a random one"})
THREADS = whole_number(1, 1024, besides={-1: "PyTorch's own choice", 0: "likewise"})
VERBOSITY = whole_number(0, 2)
RUN_TIMEOUT = quantity(run_limits.seconds)
RUN_MEMORY = quantity(run_limits.memory)
JOBS = whole_number(1, 4096, besides={-1: "all cores", 0: "likewise"})
