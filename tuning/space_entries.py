"""What a file of search spaces says of one setting: read strictly, into a dimension."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.errors import UserError, shown, unknown
from pipeline.settings.values import check_arguments
from tuning.dimensions import Choice, Dimension, Word, is_word
from tuning.number_ranges import FORMS, NumberRange, Scale

_RANGE: Mapping[str, Any] = {
    "low": float,
    "high": float,
    "scale": Scale,
    "forms": list[Any],
    "final_share": list[float],
    "when": dict[str, Any],
}
_CHOICE: Mapping[str, Any] = {"choices": dict[str, Any] | list[Any], "when": dict[str, Any]}
# What would make the task another one, so that the easiest would win.
_TASK = ("env_kwargs", "eval_env_kwargs")
_SETS: Mapping[str, Any] = {"sets": dict[str, dict[str, Any]], "when": dict[str, Any]}


@dataclass(frozen=True)
class Conditional:
    """A dimension, and when it is there.

    Attributes:
        dimension: what is chosen.
        when: for other choices by name, the words of which one must be chosen; empty for always.
    """

    dimension: Dimension
    when: Mapping[str, tuple[Word, ...]]


def read_conditional(name: str, said: Any, where: str) -> Conditional:
    """Read what stands beside a name.

    Args:
        name: of a setting, or of a choice between several sets of them.
        said: a list of values to choose from; a mapping with ``choices``, whose values have names,
            with ``sets`` of several settings, or with ``low`` and ``high``.
        where: begins every error message.

    Raises:
        UserError: if it is none of these.
    """
    place = f"{where}: {name}"
    if isinstance(said, list):
        said = {"choices": said}
    if not isinstance(said, dict):
        raise UserError(
            f"{place} must be a list of values, or map low and high, choices or sets to theirs; "
            f"not {shown(said)}"
        )
    known = _CHOICE if "choices" in said else _SETS if "sets" in said else _RANGE
    checked = check_arguments(said, _parameters(known), place, "key")
    when = {other: _words(words, f"{place}: when") for other, words in _when(checked)}
    if known is _RANGE:
        return Conditional(_number_range(name, _with_whole_ends(checked, said), place), when)
    options = checked["sets"] if known is _SETS else _options(name, checked["choices"], place)
    if len(options) < 2:
        raise UserError(f"{place}: there must be two values at least to choose from")
    return Conditional(Choice(name, options), when)


def _parameters(annotations: Mapping[str, Any]) -> dict[str, inspect.Parameter]:
    return {
        name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation)
        for name, annotation in annotations.items()
    }


def _when(checked: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return list(checked.get("when", {}).items())


def _words(said: Any, place: str) -> tuple[Word, ...]:
    words = said if isinstance(said, list) else [said]
    for word in words:
        if not is_word(word):
            raise UserError(f"{place} names values of another choice, not {shown(word)}")
    return tuple(words)


def _options(name: str, choices: Any, place: str) -> dict[Word, dict[str, Any]]:
    if isinstance(choices, dict):
        return {word: {name: value} for word, value in choices.items()}
    for value in choices:
        if not is_word(value):
            raise UserError(
                f"{place}: {shown(value)} needs a name, as in choices: {{small: [64, 64]}}"
            )
    return {value: {name: value} for value in choices}


def _with_whole_ends(checked: Mapping[str, Any], said: Mapping[str, Any]) -> dict[str, Any]:
    """What was checked, with the ends of a range whole where both are written so."""
    ends = {end: said[end] for end in ("low", "high") if isinstance(said.get(end), int)}
    return {**checked, **(ends if len(ends) == 2 else {})}


def _number_range(name: str, checked: Mapping[str, Any], place: str) -> NumberRange:
    for end in ("low", "high"):
        if end not in checked:
            raise UserError(f"{place}: {end} is missing")
    low, high, scale = checked["low"], checked["high"], checked.get("scale", "linear")
    _check_ends(low, high, scale, place)
    forms = tuple(checked.get("forms", ("constant",)))
    _check_forms(forms, place)
    share = tuple(checked.get("final_share", (0.001, 1.0)))
    if len(share) != 2 or not 0 < share[0] < share[1] < math.inf:
        raise UserError(f"{place}: final_share must be two numbers above 0, the smaller one first")
    return NumberRange(
        name,
        low,
        high,
        scale,
        tuple(form for form in forms if form in FORMS),
        (share[0], share[1]),
        {form: form for form in forms if form not in FORMS},
    )


def _check_ends(low: float, high: float, scale: Scale, place: str) -> None:
    if not -math.inf < low < high < math.inf:
        raise UserError(
            f"{place}: low must be below high, and both finite: not {shown(low)} and {shown(high)}"
        )
    if scale in {"log", "powers_of_two"} and low <= 0:
        raise UserError(f"{place}: scale {scale} needs low above 0, not {shown(low)}")
    if scale == "log_below_one" and high >= 1:
        raise UserError(f"{place}: scale {scale} needs high below 1, not {shown(high)}")
    if scale == "powers_of_two" and not all(
        isinstance(end, int) and end.bit_count() == 1 for end in (low, high)
    ):
        raise UserError(f"{place}: scale {scale} needs whole powers of two as low and high")


def _check_forms(forms: tuple[Any, ...], place: str) -> None:
    if not any(isinstance(form, str) and form in FORMS for form in forms):
        raise UserError(f"{place}: forms must name one of {', '.join(FORMS)}, and what else may be")
    for form in forms:
        if not is_word(form):
            raise UserError(f"{place}: forms are words and single values, not {shown(form)}")


def check_names(entries: Mapping[str, Conditional], where: str) -> None:
    """Make sure that nothing is chosen twice, and that the task is not chosen at all.

    Raises:
        UserError: naming the setting or parameter.
    """
    deciders: dict[str, str] = {}
    for name, entry in entries.items():
        keys = entry.dimension.keys
        task = next((key for key in keys if key.partition(".")[0] in _TASK), None)
        if task is not None:
            raise UserError(
                f"{where}: {task} is what settings are judged on, and not searched: give it by "
                "--env-kwargs, or search train_env_kwargs"
            )
        decided = keys if not entry.when else ()  # under conditions it may be one or the other
        for key in (*decided, *entry.dimension.distributions()):
            other = deciders.setdefault(key, name)
            if other != name:
                raise UserError(f"{where}: {other} and {name} both decide {key}: leave one out")


def check_order(entries: Mapping[str, Conditional], where: str) -> None:
    """Make sure that conditions speak of choices further up, and of words that these have.

    Raises:
        UserError: naming the condition.
    """
    before: dict[str, Choice] = {}
    for name, entry in entries.items():
        for other, words in entry.when.items():
            place = f"{where}: {name}: when"
            if other not in before:
                raise unknown(f"{place}: no choice above it is called", other, before)
            strange = next((word for word in words if word not in before[other].options), None)
            if strange is not None:
                raise unknown(
                    f"{place}: {other} has no value", str(strange), map(str, before[other].options)
                )
        if isinstance(entry.dimension, Choice):
            before[name] = entry.dimension
