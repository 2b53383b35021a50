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
FINAL_SHARE = (0.001, 1.0)
LEFT_OUT = object()  # in place of a setting that is not given
_PREFIXES: Mapping[str, str] = {"log_below_one": "one_minus_", "powers_of_two": "log2_"}


@dataclass(frozen=True)
class Choice:
    """One of several values, or one of several sets of settings."""

    name: str  #: name of the parameter
    options: dict[Word, dict[str, Any]]  #: the flat settings of each word
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
        with suppress(LookupError):
            self.params_of(settings)
            return self
        added = self._decided(settings)
        value = added.get(self.name, LEFT_OUT)
        # The value itself, if that is clearer for readers.
        speaks = all(is_word(option.get(self.name)) for option in self.options.values())
        word = value if speaks and is_word(value) and value not in self.options else SHIPPED
        return replace(self, options={**self.options, word: added})

    def _decided(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        return {key: settings.get(key, LEFT_OUT) for key in self.keys}


@dataclass(frozen=True)
class NumberRange:
    """A number between two ends (an integer if both are), or a schedule or word in its place.

    Chosen numbers have six digits to keep files readable.
    """

    name: str  #: name of the setting
    low: int | float  #: included
    high: int | float  #: included
    scale: Scale = "linear"  #: of equal steps; on "powers_of_two" only these are values
    #: The allowed words of `FORMS`, and words that replace the number.
    forms: tuple[Word, ...] = ("constant",)
    #: The range of an exponential schedule's end, as a share of its start.
    final_share: tuple[float, float] = FINAL_SHARE
    when: Conditions = field(default_factory=dict)
    instead: dict[str, Any] = field(default_factory=dict)  #: other values in place of the number

    def __post_init__(self) -> None:
        low, high, share = self.low, self.high, self.final_share
        if not -np.inf < low < high < np.inf:
            raise ValueError(f"low must be below high, and both finite: not {low} and {high}")
        if self.scale == "log" and low <= 0:
            raise ValueError(f"scale log needs low above 0, not {low}")
        if self.scale == "log_below_one" and high >= 1:
            raise ValueError(f"scale log_below_one needs high below 1, not {high}")
        if self.scale == "powers_of_two" and not (is_power(low) and is_power(high)):
            raise ValueError("scale powers_of_two needs whole powers of two as low and high")
        if not any(form in FORMS for form in self.forms):
            raise ValueError(f"forms must name one of {', '.join(FORMS)}, and what else may be")
        if not 0 < share[0] < share[1] < np.inf:
            raise ValueError("final_share must be two numbers above 0, the smaller one first")
        if not (isinstance(low, int) and isinstance(high, int)):
            object.__setattr__(self, "low", float(low))
            object.__setattr__(self, "high", float(high))

    @property
    def keys(self) -> tuple[str, ...]:
        """The names of its settings."""
        return (self.name,)

    @cached_property
    def _words(self) -> tuple[Word, ...]:
        """Optuna's words for the forms, the schedules first."""
        first = sorted(self.forms, key=lambda form: form not in FORMS)
        return tuple(dict.fromkeys((*first, *self.instead)))

    @property
    def _names(self) -> tuple[str, str, str]:
        """The names of its parameters: number, form, and share of the end."""
        prefix = _PREFIXES.get(self.scale, "")
        return prefix + self.name, f"{self.name}_form", f"{self.name}_final_share"

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distribution of each of its parameters."""
        number, form, share = self._names
        found: dict[str, BaseDistribution] = {}
        if len(self._words) > 1:
            found[form] = CategoricalDistribution(self._words)
        low, high = sorted((self._parameter(self.low), self._parameter(self.high)))
        is_log = self.scale in ("log", "log_below_one")
        if isinstance(low, int) and isinstance(high, int):
            found[number] = IntDistribution(low, high, log=is_log)
        else:
            found[number] = FloatDistribution(low, high, log=is_log)
        if "exponential" in self.forms:
            found[share] = FloatDistribution(*self.final_share, log=True)
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
        number, form, share = self._names
        ranges = self.distributions
        word = pick(form, ranges[form]) if form in ranges else self._words[0]
        if word not in FORMS:
            return {self.name: self.instead.get(word, word)}
        start = self._number_of(pick(number, ranges[number]))
        if word == "constant":
            return {self.name: start}
        if word == "linear":
            return {self.name: f"lin_{start}"}
        return {self.name: f"exp_{start}_{tidy(start * pick(share, ranges[share]))}"}

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that give these settings; LookupError if there are none."""
        number, form, share = self._names
        value = settings.get(self.name, LEFT_OUT)
        for word in self._words:
            if word not in FORMS and same(value, self.instead.get(word, word)):  # type: ignore[arg-type]
                return {form: word}
        kind, start, end = read = _read(value)
        if kind is None:
            raise LookupError(self.name)
        params: dict[str, Any] = {form: kind} if form in self.distributions else {}
        params[number] = self._parameter(start)
        if kind == "exponential":
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

    def including(self, settings: Mapping[str, Any]) -> NumberRange:
        """This dimension, widened if necessary to include these settings."""
        value = settings.get(self.name, LEFT_OUT)
        kind, start, end = _read(value)
        changes: list[dict[str, Any]] = [{}]
        if kind is not None:
            low, high = self.final_share
            share = end / start if kind == "exponential" else low
            other = {"forms": tuple(dict.fromkeys((*self.forms, kind)))}
            ends = {"low": min(self.low, start), "high": max(self.high, start)}
            ends["final_share"] = min(low, share), max(high, share)
            changes += [other, {**other, **ends}]
        for each in changes:
            with suppress(LookupError, ValueError):
                wider = replace(self, **each)
                wider.params_of(settings)
                return wider
        if is_word(value) and value not in self._words:
            return replace(self, forms=(*self.forms, value))
        return replace(self, instead={**self.instead, SHIPPED: value})


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
    return float(f"{number:.6g}")


def is_power(number: float) -> bool:
    """Whether a number is a whole power of two."""
    return isinstance(number, int) and number > 0 and number.bit_count() == 1


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
