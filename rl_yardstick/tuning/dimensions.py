"""The dimensions of a search space: a choice of values, or a range of numbers.

Each dimension converts between its settings and the parameters that Optuna stores for them.
Settings are flat here: the name of a nested setting is dotted, as in ``policy_kwargs.net_arch``. A
setting with the value `LEFT_OUT` is not given.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings.values import DottedName, parse_schedule
from rl_yardstick.tuning.tuning_spec import SHIPPED

# The value that Optuna stores for a choice.
Word = str | int | float | bool | None
# A function that chooses a value for the parameter of this name.
Pick = Callable[[str, BaseDistribution], Any]
# By the name of another choice, the words of which one must be chosen there; empty for none.
Conditions = Mapping[str, tuple[Word, ...]]

Scale = Literal["linear", "log", "log_below_one", "powers_of_two"]
# The meaning of a number: a constant, or the start of a schedule.
FORMS = ("constant", "linear", "exponential")
FINAL_SHARE = (0.001, 1.0)
_DIGITS = 6
_PREFIXES: Mapping[str, str] = {"log_below_one": "one_minus_", "powers_of_two": "log2_"}


LEFT_OUT = object()  # in place of a setting that is not given


@dataclass(frozen=True)
class Choice:
    """One of several values, or one of several sets of settings."""

    name: str  # name of the parameter
    options: Mapping[Word, Mapping[str, Any]]  # the flat settings of each word
    when: Conditions = field(default_factory=dict)

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The names of its settings."""
        return tuple(dict.fromkeys(key for option in self.options.values() for key in option))

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distribution of each of its parameters."""
        return {self.name: CategoricalDistribution(tuple(self.options))}

    def settings(self, pick: Pick) -> dict[str, Any]:
        """The chosen settings; calls ``pick`` only for the needed parameters."""
        return self._decided(self.options[pick(self.name, self.distributions[self.name])])

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that give these settings; LookupError if there are none."""
        for word, option in self.options.items():
            if same(self._decided(option), self._decided(settings)):
                return {self.name: word}
        raise LookupError(self.name)

    def including(self, settings: Mapping[str, Any]) -> Choice:
        """This dimension, widened if necessary to include these settings."""
        try:
            self.params_of(settings)
        except LookupError:
            added = self._decided(settings)
            value = added.get(self.name, LEFT_OUT)
            # The value itself, if that is clearer for readers.
            speaks = all(is_word(option.get(self.name)) for option in self.options.values())
            speaks = speaks and is_word(value) and value not in self.options
            word = value if speaks else SHIPPED
            return replace(self, options={**self.options, word: added})
        return self

    def _decided(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        return {key: settings.get(key, LEFT_OUT) for key in self.keys}


@dataclass(frozen=True)
class NumberRange:
    """A number between two ends (an integer if both are), or a schedule or word in its place.

    Chosen numbers have six digits to keep files readable.
    """

    name: str  # name of the setting
    low: float  # included
    high: float  # included
    scale: Scale = "linear"  # the scale of equal steps; on "powers_of_two" only these are values
    forms: tuple[str, ...] = ("constant",)  # the allowed words of `FORMS`
    # The range of an exponential schedule's end, as a share of its start.
    final_share: tuple[float, float] = FINAL_SHARE
    # Values in place of a number, by Optuna's words for them.
    instead: Mapping[Word, Any] = field(default_factory=dict)
    when: Conditions = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
        """The names of its settings."""
        return (self.name,)

    @property
    def _number(self) -> str:
        return _PREFIXES.get(self.scale, "") + self.name

    @property
    def _form(self) -> str:
        return f"{self.name}_form"

    @property
    def _share(self) -> str:
        return f"{self.name}_final_share"

    @property
    def _words(self) -> tuple[Word, ...]:
        return (*self.forms, *self.instead)

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distribution of each of its parameters."""
        found: dict[str, BaseDistribution] = {}
        if len(self._words) > 1:
            found[self._form] = CategoricalDistribution(self._words)
        low, high = sorted((self._parameter(self.low), self._parameter(self.high)))
        is_log = self.scale in ("log", "log_below_one")
        if isinstance(low, int) and isinstance(high, int):
            found[self._number] = IntDistribution(low, high, log=is_log)
        else:
            found[self._number] = FloatDistribution(low, high, log=is_log)
        if "exponential" in self.forms:
            found[self._share] = FloatDistribution(*self.final_share, log=True)
        return found

    def _parameter(self, number: float) -> float:
        """Convert a number to Optuna's parameter."""
        if self.scale == "log_below_one":
            return tidy(1.0 - number)
        return int(number).bit_length() - 1 if self.scale == "powers_of_two" else number

    def _number_of(self, parameter: float) -> float:
        """Convert Optuna's parameter to a number."""
        if self.scale == "log_below_one":
            return round(1.0 - tidy(parameter), 12)
        if self.scale == "powers_of_two":
            return 1 << int(parameter)
        number = parameter if isinstance(parameter, int) else tidy(parameter)
        return min(max(number, self.low), self.high)

    def settings(self, pick: Pick) -> dict[str, Any]:
        """The chosen settings; calls ``pick`` only for the needed parameters."""
        ranges = self.distributions
        form = pick(self._form, ranges[self._form]) if self._form in ranges else self._words[0]
        if form not in self.forms:
            return {self.name: self.instead[form]}
        number = self._number_of(pick(self._number, ranges[self._number]))
        if form == "constant":
            return {self.name: number}
        if form == "linear":
            return {self.name: f"lin_{number}"}
        end = tidy(number * pick(self._share, ranges[self._share]))
        return {self.name: f"exp_{number}_{end}"}

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that give these settings; LookupError if there are none."""
        value = settings.get(self.name, LEFT_OUT)
        for word, other in self.instead.items():
            if same(value, other):
                return {self._form: word}
        form, start, end = _read(value)
        if form is None:
            raise LookupError(self.name)
        params: dict[str, Any] = {self._form: form} if len(self._words) > 1 else {}
        params[self._number] = self._parameter(start)
        if form == "exponential":
            params[self._share] = end / start
        if all(self._holds(name, value) for name, value in params.items()):
            again = self.settings(lambda name, _: params[name])[self.name]
            if _read(again) == (form, start, end):
                return params
        raise LookupError(self.name)

    def _holds(self, param: str, value: Any) -> bool:
        kind = self.distributions.get(param)
        if isinstance(kind, FloatDistribution | IntDistribution):
            return bool(kind.low <= value <= kind.high)
        return isinstance(kind, CategoricalDistribution) and value in kind.choices

    def including(self, settings: Mapping[str, Any]) -> NumberRange:
        """This dimension, widened if necessary to include these settings."""
        value = settings.get(self.name, LEFT_OUT)
        form, start, end = _read(value)
        wider = [self]
        if form is not None:
            wider.append(replace(self, forms=tuple(dict.fromkeys((*self.forms, form)))))
        if form is not None and (self.scale != "log" or start > 0):
            low, high = self.final_share
            share = end / start if form == "exponential" else low
            reaching = replace(
                wider[-1],
                low=min(self.low, start),
                high=max(self.high, start),
                final_share=(min(low, share), max(high, share)),
            )
            wider.append(reaching)
        for each in wider:
            with contextlib.suppress(LookupError, ValueError):
                each.params_of(settings)
                return each
        word = value if is_word(value) and value not in self._words else SHIPPED
        return replace(self, instead={**self.instead, word: value})


Dimension = Choice | NumberRange


def spread(distribution: BaseDistribution, n: int) -> list[Any]:
    """At most ``n`` values from one end of a distribution to the other; all words of a choice."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    assert isinstance(distribution, FloatDistribution | IntDistribution)
    between = np.geomspace if distribution.log else np.linspace
    values = between(distribution.low, distribution.high, n).tolist()
    if isinstance(distribution, IntDistribution):
        return sorted({round(value) for value in values})
    inside = [min(max(tidy(v), distribution.low), distribution.high) for v in values]
    return list(dict.fromkeys(inside))


def tidy(number: float) -> float:
    """Round a number to six digits."""
    return float(f"{number:.{_DIGITS}g}")


def _read(value: Any) -> tuple[str | None, float, float]:
    """Form, start and end of a number or schedule; no form for other values."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "constant", value, value
    if isinstance(value, str):
        with contextlib.suppress(UserError):
            schedule = parse_schedule(value, "")
            return schedule.kind, schedule.start, schedule.end
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
    if isinstance(value, DottedName):
        return value.name
    return (bool, value) if isinstance(value, bool) else value
