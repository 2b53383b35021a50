"""The dimensions of a search space: a choice of values, or a range of numbers.

Each dimension converts between its settings and the parameters that Optuna stores for them.
Settings are flat here: the name of a nested setting is dotted, as in ``policy_kwargs.net_arch``. A
setting with the value `LEFT_OUT` is not given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from pydantic.dataclasses import dataclass

from rl_yardstick.tuning.tuning_spec import SHIPPED

# The value that Optuna stores for a choice.
Word = str | int | float | bool | None
# A function that chooses a value for the parameter of this name.
Pick = Callable[[str, BaseDistribution], Any]
# By the name of another choice, the words of which one must be chosen there; empty for none.
Conditions = dict[str, tuple[Word, ...]]

Scale = Literal["linear", "log", "log_below_one", "powers_of_two"]
# The meaning of a number: a constant, or the start of a schedule.
FORMS = ("constant", "linear", "exponential")
LEFT_OUT = object()  # in place of a setting that is not given
_POINTS = 98  # over a range
_PREFIXES: Mapping[str, str] = {"log_below_one": "one_minus_", "powers_of_two": "log2_"}


@dataclass(frozen=True)
class Range:
    """The numbers between two ends (integers if both are), with six digits for readable files."""

    low: int | float  #: included
    high: int | float  #: included
    scale: Scale = "linear"  #: of equal steps; on "powers_of_two" only these are values
    #: The range of an exponential schedule's end, as a share of its start.
    final_share: tuple[float, float] = (0.001, 1.0)

    def __post_init__(self) -> None:
        low, high, share = self.low, self.high, self.final_share
        if not -np.inf < low < high < np.inf:
            raise ValueError(f"low must be below high, and both finite: not {low} and {high}")
        if self.scale == "log" and low <= 0:
            raise ValueError(f"scale log needs low above 0, not {low}")
        if self.scale == "log_below_one" and high >= 1:
            raise ValueError(f"scale log_below_one needs high below 1, not {high}")
        powers = (isinstance(n, int) and n > 0 and n.bit_count() == 1 for n in (low, high))
        if self.scale == "powers_of_two" and not all(powers):
            raise ValueError("scale powers_of_two needs whole powers of two as low and high")
        if not 0 < share[0] < share[1] < np.inf:
            raise ValueError("final_share must be two numbers above 0, the smaller one first")
        if not (isinstance(low, int) and isinstance(high, int)):
            object.__setattr__(self, "low", float(low))
            object.__setattr__(self, "high", float(high))

    @cached_property
    def distribution(self) -> FloatDistribution | IntDistribution:
        """The distribution of Optuna's parameter for the number."""
        low, high = sorted((self.parameter(self.low), self.parameter(self.high)))
        is_log = self.scale in ("log", "log_below_one")
        if isinstance(low, int) and isinstance(high, int):
            return IntDistribution(low, high, log=is_log)
        return FloatDistribution(low, high, log=is_log)

    def parameter(self, number: float) -> float:
        """Convert a number to Optuna's parameter."""
        if self.scale == "log_below_one":
            return tidy(1.0 - number)
        return int(number).bit_length() - 1 if self.scale == "powers_of_two" else number

    def number(self, parameter: float) -> float:
        """Convert Optuna's parameter to a number."""
        if self.scale == "log_below_one":
            return round(1.0 - tidy(parameter), 12)
        if self.scale == "powers_of_two":
            return 1 << int(parameter)
        number = parameter if isinstance(parameter, int) else tidy(parameter)
        return min(max(number, self.low), self.high)


@dataclass(frozen=True)
class Dimension:
    """A choice of values or of sets of settings, a number, or a number with words in its place."""

    name: str  #: of the setting, or of the choice of several settings
    options: dict[Word, dict[str, Any]]  #: the flat settings of each word
    #: The words of `FORMS` that a number may have, and its range; empty and None for a choice.
    forms: tuple[str, ...] = ()
    range: Range | None = None
    when: Conditions = field(default_factory=dict)

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The names of its settings."""
        number = [] if self.range is None else [self.name]
        return tuple(dict.fromkeys([*number, *(key for o in self.options.values() for key in o)]))

    @property
    def words(self) -> tuple[Word, ...]:
        """What Optuna chooses from, before it chooses a number."""
        return (*self.forms, *self.options)

    @cached_property
    def _parameters(self) -> tuple[str, str, str]:
        """The names of its parameters: word, number, and share of the end."""
        if self.range is None:
            return self.name, "", ""
        prefix = _PREFIXES.get(self.range.scale, "")
        return f"{self.name}_form", prefix + self.name, f"{self.name}_final_share"

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distribution of each of its parameters."""
        word, number, share = self._parameters
        found: dict[str, BaseDistribution] = {}
        if len(self.words) > 1:
            found[word] = CategoricalDistribution(self.words)
        if self.range is not None:
            found[number] = self.range.distribution
        if self.range is not None and "exponential" in self.forms:
            found[share] = FloatDistribution(*self.range.final_share, log=True)
        return found

    def settings(self, pick: Pick) -> dict[str, Any]:
        """The chosen settings; calls ``pick`` only for the needed parameters."""
        ranges, (choice, number, share) = self.distributions, self._parameters
        word = pick(choice, ranges[choice]) if choice in ranges else self.words[0]
        if self.range is None or word not in self.forms:
            return self._decided(self.options[word])
        start = self.range.number(pick(number, ranges[number]))
        if word == "constant":
            return {self.name: start}
        if word == "linear":
            return {self.name: f"lin_{start}"}
        return {self.name: f"exp_{start}_{tidy(start * pick(share, ranges[share]))}"}

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that give these settings; LookupError if there are none."""
        choice, number, share = self._parameters
        for option, given in self.options.items():
            if same(self._decided(given), self._decided(settings)):
                return {choice: option}
        form, start, end = read = _read(settings.get(self.name))
        if self.range is None or form is None:
            raise LookupError(self.name)
        params: dict[str, Any] = {choice: form} if choice in self.distributions else {}
        params[number] = self.range.parameter(start)
        if form == "exponential":
            params[share] = end / start
        if all(self._holds(name, value) for name, value in params.items()):
            again = self.settings(lambda name, _: params[name])[self.name]
            if _read(again) == read:
                return params
        raise LookupError(self.name)

    def _holds(self, param: str, value: Any) -> bool:
        kind = self.distributions.get(param)
        if isinstance(kind, FloatDistribution | IntDistribution):
            return bool(kind.low <= value <= kind.high)
        return isinstance(kind, CategoricalDistribution) and value in kind.choices

    def _decided(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        return {key: settings.get(key, LEFT_OUT) for key in self.keys}

    def including(self, settings: Mapping[str, Any]) -> Dimension:
        """This dimension, widened if necessary to include these settings."""
        added = self._decided(settings)
        value = added.get(self.name, LEFT_OUT)
        changes: list[dict[str, Any]] = [{}]
        form, start, end = _read(value)
        if self.range is not None and form is not None:
            forms = tuple(dict.fromkeys((*self.forms, form)))
            low, high = self.range.final_share
            share = end / start if form == "exponential" else low
            ends = {"low": min(self.range.low, start), "high": max(self.range.high, start)}
            changes.append({"forms": forms})
            with suppress(ValueError):
                shares = min(low, share), max(high, share)
                wider = replace(self.range, **ends, final_share=shares)  # type: ignore[arg-type]
                changes.append({"forms": forms, "range": wider})
        for each in changes:
            with suppress(LookupError, ValueError):
                found = replace(self, **each)
                found.params_of(settings)
                return found
        # The value itself as the word, if that is clearer for readers.
        speaks = all(is_word(option.get(self.name)) for option in self.options.values())
        word = value if speaks and is_word(value) and value not in self.words else SHIPPED
        return replace(self, options={**self.options, word: added})


def ends(distribution: BaseDistribution) -> list[Any]:
    """All words of a choice, or the ends of a range; of floats, also one between them."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    assert isinstance(distribution, FloatDistribution | IntDistribution)
    low, high = distribution.low, distribution.high
    if isinstance(distribution, IntDistribution):
        return [low, high]
    steps = np.geomspace if distribution.log else np.linspace
    between = steps(low, high, _POINTS)[1]  # which is rarely a whole number
    return [low, tidy(between), high]


def tidy(number: float) -> float:
    """Round a number to six digits."""
    return float(f"{number:.6g}")


def _read(value: Any) -> tuple[str | None, float, float]:
    """Form, start and end of a number or schedule; no form for other values."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "constant", value, value
    kind, *numbers = value.split("_") if isinstance(value, str) else [""]
    with suppress(ValueError, LookupError):
        form = {"lin": "linear", "exp": "exponential"}[kind]
        start, end = [*map(float, numbers), 0.0][:2]
        return form, start, end
    return None, 0.0, 0.0


def is_word(value: object) -> bool:
    """Whether Optuna can store the value in a choice."""
    return value is None or isinstance(value, str | int | float)


def same(first: object, second: object) -> bool:
    """Whether two values are the same setting: 1 equals 1.0 but not true; tuples equal lists."""
    return _comparable(first) == _comparable(second)


def _comparable(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _comparable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_comparable(item) for item in value]
    return (bool, value) if isinstance(value, bool) else value
