"""What a search may choose between, as settings and as the parameters that Optuna knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.settings.values import DottedName

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

# What Optuna stores of a choice.
Word = str | int | float | bool | None
# Chooses a value for a parameter of this name.
Pick = Callable[[str, "BaseDistribution"], Any]

SHIPPED = "shipped"


class Absent(Enum):
    """A setting that is not said."""

    LEFT_OUT = "left out"


LEFT_OUT = Absent.LEFT_OUT


class Dimension(Protocol):
    """One thing to be chosen, which may take several of Optuna's parameters.

    Settings are flat here: of those inside another the name is dotted, as in
    ``policy_kwargs.net_arch``. A setting that is `LEFT_OUT` is not said.
    """

    @property
    def name(self) -> str:
        """How the file calls it, and other dimensions that depend on it."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The settings that it decides."""

    def distributions(self) -> dict[str, BaseDistribution]:
        """What each of its parameters is drawn from."""

    def settings(self, pick: Pick) -> dict[str, Any]:
        """What is chosen, asking for those parameters alone that it takes."""

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that lead to these settings.

        Raises:
            LookupError: if none do.
        """

    def including(self, settings: Mapping[str, Any]) -> Dimension:
        """As much wider as it takes to have these settings among its choices."""

    def grid(self, n: int) -> dict[str, list[Any]]:
        """Values for each parameter: all words, and at most ``n`` numbers from end to end."""


@dataclass(frozen=True)
class Choice:
    """One of several values, or one of several sets of settings.

    Attributes:
        name: of the parameter.
        options: the flat settings that each word stands for.
    """

    name: str
    options: Mapping[Word, Mapping[str, Any]]

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(key for option in self.options.values() for key in option))

    @cached_property
    def _words(self) -> BaseDistribution:
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution(tuple(self.options))

    def distributions(self) -> dict[str, BaseDistribution]:
        return {self.name: self._words}

    def settings(self, pick: Pick) -> dict[str, Any]:
        chosen = self.options[pick(self.name, self._words)]
        return {key: chosen.get(key, LEFT_OUT) for key in self.keys}

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        wanted = {key: settings.get(key, LEFT_OUT) for key in self.keys}
        for word, option in self.options.items():
            if same({key: option.get(key, LEFT_OUT) for key in self.keys}, wanted):
                return {self.name: word}
        raise LookupError(self.name)

    def including(self, settings: Mapping[str, Any]) -> Choice:
        try:
            self.params_of(settings)
        except LookupError:
            added = {key: settings.get(key, LEFT_OUT) for key in self.keys}
            return replace(self, options={**self.options, self._word_for(added): added})
        return self

    def _word_for(self, added: Mapping[str, Any]) -> Word:
        """The value itself where that tells the reader more."""
        value = added.get(self.name, LEFT_OUT)
        speaks = all(is_word(o.get(self.name)) for o in self.options.values())
        return value if speaks and is_word(value) and value not in self.options else SHIPPED

    def grid(self, n: int) -> dict[str, list[Any]]:
        return {self.name: list(self.options)}


def is_word(value: object) -> bool:
    """Whether Optuna can store the value as one of a choice."""
    return value is None or isinstance(value, str | int | float)


def same(first: object, second: object) -> bool:
    """Whether two values mean the same setting: 1 is 1.0, and not true; a tuple is a list."""
    return _comparable(first) == _comparable(second)


def _comparable(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _comparable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_comparable(item) for item in value]
    if isinstance(value, DottedName):
        return value.name
    return (bool, value) if isinstance(value, bool) else value
