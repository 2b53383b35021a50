"""The arguments that bandit agents share, and the checks of all of them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable
from typing import Any, Literal, TypedDict, get_args

import torch as th
from gymnasium import spaces

from agents.common.step_sizes import SAMPLE_AVERAGE

TieBreaking = Literal["random", "first"]
ExplorationDecay = Literal["constant", "linear", "exponential"]


class CommonArguments(TypedDict, total=False):
    """What every bandit agent's constructor takes; see `agents.bandits.base.BanditAlgorithm`."""

    tie_breaking: TieBreaking
    stats_window_size: int
    tensorboard_log: str | None
    verbose: int
    seed: int | None
    device: th.device | str
    _init_setup_model: bool


class TableArguments(CommonArguments, total=False):
    """What those with a score for each arm take; see `agents.bandits.table_bandit.TableBandit`."""

    ignore_context: bool


class LinearArguments(CommonArguments, total=False):
    """What those with a linear model take; see `agents.bandits.linear.LinearBanditAgent`."""

    ridge: float


def full_signature(cls: Any) -> inspect.Signature:
    """The constructor's own arguments, and in place of ``**kwargs`` those of the base class.

    Hyperparameter files are checked against it, and `help` shows it.
    """
    own = inspect.signature(cls.__init__, eval_str=True).parameters
    merged = {name: p for name, p in own.items() if name != "self" and p.kind is not p.VAR_KEYWORD}
    if any(p.kind is p.VAR_KEYWORD for p in own.values()):
        for name, parameter in full_signature(cls.__mro__[1]).parameters.items():
            merged.setdefault(name, parameter)
    return inspect.Signature(list(merged.values()))


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


def check_at_least(low: float, values: Iterable[tuple[str, Any]]) -> None:
    """Refuse numbers below ``low``; what is no number is left alone.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in values:
        if isinstance(value, int | float) and not value >= low:
            raise ValueError(f"{name} must be at least {low:g}, not {value}")


def check_above_zero(values: Iterable[tuple[str, Any]]) -> None:
    """Refuse numbers that are not above 0; what is no number is left alone.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in values:
        if isinstance(value, int | float) and not value > 0:
            raise ValueError(f"{name} must be above 0, not {value}")


def check_share(values: Iterable[tuple[str, float]]) -> None:
    """Refuse numbers outside [0, 1].

    Raises:
        ValueError: naming the argument.
    """
    for name, value in values:
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must lie between 0 and 1, not {value}")


def check_finite(values: Iterable[tuple[str, float]]) -> None:
    """Refuse infinite numbers and nan.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in values:
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, not {value}")


def check_epsilons(agent: Any) -> None:
    """Check what says how epsilon falls.

    Raises:
        ValueError: naming the argument and what it must be.
    """
    check_option("exploration_decay", agent.exploration_decay, ExplorationDecay)
    check_share(
        (name, getattr(agent, name))
        for name in ("exploration_initial_eps", "exploration_final_eps", "exploration_fraction")
    )


def check_learning_rate(learning_rate: object) -> None:
    """Refuse words other than that for sample averages.

    Raises:
        ValueError: naming what it can be.
    """
    if isinstance(learning_rate, str) and learning_rate != SAMPLE_AVERAGE:
        raise ValueError(
            f"learning_rate must be a number, a schedule or {SAMPLE_AVERAGE!r}, "
            f"not {learning_rate!r}"
        )
