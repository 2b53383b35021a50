"""Checks of agents' arguments: each failure is one line that names the argument and its range."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral
from typing import Any, get_args

from gymnasium import spaces

from agents.common.signatures import ExplorationDecay
from agents.common.step_sizes import SAMPLE_AVERAGE

Settings = Iterable[tuple[str, Any]]


def settings_of(agent: object, *names: str) -> Settings:
    """The named arguments of an agent with their values."""
    return [(name, getattr(agent, name)) for name in names]


def check_space(agent: object, role: str, space: spaces.Space[Any]) -> None:
    """Refuse spaces other than Discrete ones that start at 0.

    Raises:
        ValueError: naming the agent, what the space is for, and the space.
    """
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        raise ValueError(
            f"{type(agent).__name__} needs {role} in a Discrete space that starts at 0, not {space}"
        )


def check_option(name: str, value: object, options: Any) -> None:
    """Refuse words that are not in the Literal ``options``.

    Raises:
        ValueError: naming the argument and the words that it can be.
    """
    if value not in get_args(options):
        raise ValueError(f"{name} must be one of {', '.join(get_args(options))}, not {value!r}")


def check_at_least(low: float, settings: Settings) -> None:
    """Refuse numbers below ``low``; what is no number is left alone.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in settings:
        if isinstance(value, int | float) and not value >= low:
            raise ValueError(f"{name} must be at least {low:g}, not {value}")


def check_whole(low: int, settings: Settings, high: int = 10**9) -> None:
    """Refuse what is no whole number, and numbers below ``low`` or above ``high``.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in settings:
        if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
            raise ValueError(f"{name} must be a whole number of at least {low}, not {value!r}")
        if int(value) > high:
            raise ValueError(f"{name} must be at most {high}, not {value}")


def check_above_zero(settings: Settings) -> None:
    """Refuse numbers that are not above 0; what is no number is left alone.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in settings:
        if isinstance(value, int | float) and not value > 0:
            raise ValueError(f"{name} must be above 0, not {value}")


def check_share(settings: Settings) -> None:
    """Refuse numbers outside [0, 1].

    Raises:
        ValueError: naming the argument.
    """
    for name, value in settings:
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must lie between 0 and 1, not {value}")


def check_finite(settings: Settings) -> None:
    """Refuse infinite numbers and nan.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in settings:
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, not {value}")


def check_epsilons(agent: Any) -> None:
    """Check what says how epsilon falls.

    Raises:
        ValueError: naming the argument and what it must be.
    """
    check_option("exploration_decay", agent.exploration_decay, ExplorationDecay)
    names = ("exploration_fraction", "exploration_initial_eps", "exploration_final_eps")
    check_share(settings_of(agent, *names))


def check_learning_rate(learning_rate: object) -> None:
    """Refuse words other than that for sample averages, and numbers that are no step sizes.

    Raises:
        ValueError: naming what it can be.
    """
    if isinstance(learning_rate, int | float):
        check_at_least(0.0, [("learning_rate", learning_rate)])
        check_finite([("learning_rate", learning_rate)])
    if isinstance(learning_rate, str) and learning_rate != SAMPLE_AVERAGE:
        raise ValueError(
            f"learning_rate must be a number, a schedule or {SAMPLE_AVERAGE!r}, "
            f"not {learning_rate!r}"
        )
