"""A number between two ends, and the schedules and words that may stand in its place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

from pipeline.errors import UserError
from pipeline.settings.values import parse_schedule
from tuning.dimensions import LEFT_OUT, SHIPPED, Pick, Word, is_word, same

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

Scale = Literal["linear", "log", "log_below_one", "powers_of_two"]
# What a number may be: itself at all times, or where a schedule begins.
FORMS = ("constant", "linear", "exponential")
_DIGITS = 6
_PREFIXES: Mapping[str, str] = {"log_below_one": "one_minus_", "powers_of_two": "log2_"}


@dataclass(frozen=True)
class NumberRange:
    """A number to be chosen; whole where both ends are.

    Chosen numbers have six digits, so that files stay readable.

    Attributes:
        name: of the setting.
        low: the lower end, included.
        high: the upper end, included.
        scale: on which steps are alike: of the number, its logarithm, the logarithm of what it
            lacks to 1, or as powers of two, of which alone it then takes values.
        forms: the words of `FORMS` that it may take. An exponential schedule ends at a share of
            its start that is chosen too.
        final_share: the ends of that share, on a logarithmic scale.
        instead: what may stand in place of a number, by the word that Optuna knows it by.
    """

    name: str
    low: float
    high: float
    scale: Scale = "linear"
    forms: tuple[str, ...] = ("constant",)
    final_share: tuple[float, float] = (0.001, 1.0)
    instead: Mapping[Word, Any] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
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

    def distributions(self) -> dict[str, BaseDistribution]:
        return dict(self._ends)

    @cached_property
    def _ends(self) -> dict[str, BaseDistribution]:
        from optuna.distributions import CategoricalDistribution, FloatDistribution

        found: dict[str, BaseDistribution] = {}
        if len(self._words) > 1:
            found[self._form] = CategoricalDistribution(self._words)
        found[self._number] = self._number_distribution()
        if "exponential" in self.forms:
            found[self._share] = FloatDistribution(*self.final_share, log=True)
        return found

    def _number_distribution(self) -> BaseDistribution:
        from optuna.distributions import FloatDistribution, IntDistribution

        low, high = sorted((self._parameter(self.low), self._parameter(self.high)))
        if self.scale == "log_below_one":
            return FloatDistribution(low, high, log=True)
        if isinstance(low, int) and isinstance(high, int):
            return IntDistribution(low, high, log=self.scale == "log")
        return FloatDistribution(low, high, log=self.scale == "log")

    def _parameter(self, number: float) -> float:
        """What Optuna is told of a number."""
        match self.scale:
            case "log_below_one":
                return tidy(1.0 - number)
            case "powers_of_two":
                return int(number).bit_length() - 1
        return number

    def _number_of(self, parameter: float) -> float:
        """The number that a parameter stands for."""
        match self.scale:
            case "log_below_one":
                return round(1.0 - tidy(parameter), 12)
            case "powers_of_two":
                return 1 << int(parameter)
        number = parameter if isinstance(parameter, int) else tidy(parameter)
        return min(max(number, self.low), self.high)

    def settings(self, pick: Pick) -> dict[str, Any]:
        ranges = self._ends
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
        value = settings.get(self.name, LEFT_OUT)
        for word, other in self.instead.items():
            if same(value, other):
                return {self._form: word}
        params = self._numeric_params(value)
        ranges = self._ends
        inside = all(name in ranges and _holds(ranges[name], p) for name, p in params.items())
        if inside:
            again = self.settings(lambda name, _: params[name])[self.name]
            if _read(again) == _read(value):
                return params
        raise LookupError(self.name)

    def _numeric_params(self, value: Any) -> dict[str, Any]:
        """The parameters of a number or schedule, wherever the ends of the range are."""
        form, start, end = _read(value)
        if form is None:
            raise LookupError(self.name)
        params: dict[str, Any] = {self._form: form} if len(self._words) > 1 else {}
        params[self._number] = self._parameter(start)
        if form == "exponential":
            params[self._share] = end / start
        return params

    def including(self, settings: Mapping[str, Any]) -> NumberRange:
        value = settings.get(self.name, LEFT_OUT)
        for wider in (self, self._with_form(value), self._reaching(value)):
            try:
                wider.params_of(settings)
            except (LookupError, ValueError):
                continue
            return wider
        word = value if is_word(value) and value not in self._words else SHIPPED
        return replace(self, instead={**self.instead, word: value})

    def _with_form(self, value: Any) -> NumberRange:
        form, _, _ = _read(value)
        if form is None or form in self.forms:
            return self
        return replace(self, forms=(*self.forms, form))

    def _reaching(self, value: Any) -> NumberRange:
        form, start, end = _read(value)
        if form is None or (self.scale == "log" and start <= 0):
            return self
        low, high = self.final_share
        share = end / start if form == "exponential" else low
        return replace(
            self._with_form(value),
            low=min(self.low, start),
            high=max(self.high, start),
            final_share=(min(low, share), max(high, share)),
        )

    def grid(self, n: int) -> dict[str, list[Any]]:
        return {name: spread(ends, n) for name, ends in self.distributions().items()}


def _holds(distribution: BaseDistribution, value: Any) -> bool:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(distribution, FloatDistribution | IntDistribution):
        return bool(distribution.low <= value <= distribution.high)
    return isinstance(distribution, CategoricalDistribution) and value in distribution.choices


def spread(distribution: BaseDistribution, n: int) -> list[Any]:
    """At most ``n`` values from one end of a distribution to the other; of words all."""
    import numpy as np
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    if not isinstance(distribution, FloatDistribution | IntDistribution):
        raise TypeError(distribution)
    between = np.geomspace if distribution.log else np.linspace
    values = between(distribution.low, distribution.high, n).tolist()
    if isinstance(distribution, IntDistribution):
        return sorted({round(value) for value in values})
    inside = [min(max(tidy(v), distribution.low), distribution.high) for v in values]
    return list(dict.fromkeys(inside))


def tidy(number: float) -> float:
    """The number with six digits."""
    return float(f"{number:.{_DIGITS}g}")


def _read(value: Any) -> tuple[str | None, float, float]:
    """Form, start and end of a number or schedule; no form for what is neither."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "constant", value, value
    if isinstance(value, str):
        try:
            schedule = parse_schedule(value, "")
        except UserError:
            return None, 0.0, 0.0
        return schedule.kind, schedule.start, schedule.end
    return None, 0.0, 0.0
