"""Values from files and command lines, read as what a constructor's annotations ask for.

A whole number may be written 1e6, a number as a text, a tuple as a list, a class by its name, a
schedule as ``lin_0.001``. What fits none of an argument's types is a mistake and said so.
"""

from __future__ import annotations

import collections.abc
import contextlib
import math
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin

from pipeline.errors import UserError, did_you_mean, shown
from pipeline.settings.literals import DottedName, parse_literal

_SCHEDULE = re.compile(r"([A-Za-z]+)_([-+.\d][^_]*)(?:_([^_]+))?")
_SCHEDULE_FORMS = "lin_START, lin_START_END and exp_START_END"
_CLASS_NAME = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*")


@dataclass(frozen=True)
class ScheduleSpec:
    """How a number changes over training, from ``start`` at the first step to ``end`` at the last.

    Attributes:
        kind: whether it moves by a constant amount a step, or by a constant factor.
    """

    kind: Literal["linear", "exponential"]
    start: float
    end: float


class _MisfitError(Exception):
    """A value that cannot be read as one of an argument's types; another may fit."""


def coerce(value: Any, annotation: Any, where: str) -> Any:
    """Read ``value`` as ``annotation`` asks.

    Args:
        value: a plain value, as it stands in a file or on the command line.
        annotation: a type; of a union the first reading that fits, numbers before texts.
        where: names the value in error messages.

    Returns:
        The value; classes as `DottedName`, schedules as `ScheduleSpec`. Where the annotation allows
        a type not known here, what fits no other is left as it was.

    Raises:
        UserError: if no reading fits.
    """
    options = _options(annotation)
    for kind, read in _READERS:
        for option in options:
            if _kind(option) is kind:
                try:
                    return read(value, option, where)
                except _MisfitError:
                    continue
    if any(_kind(option) is None for option in options):
        return value
    words = [word for option in options if _kind(option) is Literal for word in get_args(option)]
    hint = did_you_mean(value, words) if isinstance(value, str) else ""
    hint = f": {hint}" if hint.startswith("did") else ""
    raise UserError(f"{where} must be {_describe(annotation)}, not {shown(value)}{hint}")


def parse_schedule(text: str, where: str) -> ScheduleSpec:
    """Read ``lin_0.001`` (to 0), ``lin_0.001_0.0001`` or ``exp_0.001_0.0001``.

    Raises:
        UserError: if the text is none of these.
    """
    match = _SCHEDULE.fullmatch(text)
    try:
        start, end = (_finite(part or "0") for part in match.group(2, 3)) if match else (0.0, 0.0)
    except _MisfitError:
        match = None
    if not match or match[1] not in {"lin", "exp"}:
        raise UserError(f"{where}: unknown schedule {shown(text)}: there are {_SCHEDULE_FORMS}")
    if match[1] == "lin":
        return ScheduleSpec("linear", start, end)
    if min(start, end) <= 0:
        raise UserError(f"{where}: {shown(text)} needs a start and an end above 0: exp_START_END")
    return ScheduleSpec("exponential", start, end)


def _options(annotation: Any) -> tuple[Any, ...]:
    if get_origin(annotation) in {Union, types.UnionType}:
        return tuple(option for part in get_args(annotation) for option in _options(part))
    return (annotation,)


def _kind(option: Any) -> Any:
    """What `_READERS` calls this type; None where it does not know it."""
    origin = get_origin(option) or option
    if origin is collections.abc.Callable:
        return Callable if get_args(option) == ([float], float) else None
    return _KINDS.get(origin) if isinstance(origin, collections.abc.Hashable) else None


def _describe(annotation: Any) -> str:
    return " or ".join(dict.fromkeys(map(_describe_option, _options(annotation))))


def _describe_option(option: Any) -> str:
    kind = _kind(option)
    if kind is Literal:
        return f"one of {', '.join(map(repr, get_args(option)))}"
    if kind is tuple and Ellipsis not in get_args(option):
        return f"a list of {' and '.join(map(_describe, get_args(option)))}"
    return _DESCRIPTIONS.get(kind, "a value")


def _read_none(value: Any, option: Any, where: str) -> None:
    if value is not None:
        raise _MisfitError


def _read_choice(value: Any, option: Any, where: str) -> Any:
    for choice in get_args(option):
        if type(choice) is type(value) and choice == value:
            return choice
    raise _MisfitError


def _read_bool(value: Any, option: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise _MisfitError
    return value


def _read_int(value: Any, option: Any, where: str) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    with contextlib.suppress(ValueError):
        # Exact, where the detour by way of a float would not be.
        if isinstance(value, str):
            return int(value)
    number = _read_float(value, option, where)
    if not number.is_integer():
        raise _MisfitError
    return int(number)


def _read_float(value: Any, option: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise _MisfitError
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise _MisfitError from None
    if math.isnan(number):
        raise _MisfitError
    return number


def _finite(text: str) -> float:
    number = _read_float(text, float, "")
    if math.isinf(number):
        raise _MisfitError
    return number


def _read_schedule(value: Any, option: Any, where: str) -> ScheduleSpec:
    if isinstance(value, ScheduleSpec):
        return value
    if isinstance(value, str) and _SCHEDULE.fullmatch(value):
        return parse_schedule(value, where)
    raise _MisfitError


def _read_dotted_class(value: Any, option: Any, where: str) -> DottedName:
    if isinstance(value, str) and "." not in value:
        raise _MisfitError
    return _read_class(value, option, where)


def _read_class(value: Any, option: Any, where: str) -> DottedName:
    if isinstance(value, str) and _CLASS_NAME.fullmatch(value):
        return DottedName(value)
    if not isinstance(value, DottedName):
        raise _MisfitError
    return value


def _read_text(value: Any, option: Any, where: str) -> str:
    if not isinstance(value, str):
        raise _MisfitError
    return value


def _read_mapping(value: Any, option: Any, where: str) -> dict[str, Any]:
    mapping = parse_literal(value, where) if isinstance(value, str) else value
    if not (isinstance(mapping, dict) and all(isinstance(key, str) for key in mapping)):
        raise _MisfitError
    kind = (get_args(option) or (str, Any))[1]
    return {key: coerce(item, kind, f"{where}: {key}") for key, item in mapping.items()}


def _read_list(value: Any, option: Any, where: str) -> list[Any]:
    (kind,) = get_args(option) or (Any,)
    return [coerce(item, kind, f"{where}[{i}]") for i, item in enumerate(_items(value, where))]


def _read_tuple(value: Any, option: Any, where: str) -> tuple[Any, ...]:
    items = _items(value, where)
    kinds = get_args(option) or (Any, ...)
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(items)
    if len(items) != len(kinds):
        raise _MisfitError
    return tuple(
        coerce(item, kind, f"{where}[{i}]")
        for i, (item, kind) in enumerate(zip(items, kinds, strict=True))
    )


def _items(value: Any, where: str) -> Sequence[Any]:
    items = parse_literal(value, where) if isinstance(value, str) else value
    if not isinstance(items, list | tuple):
        raise _MisfitError
    return items


# In this order: a text is what remains when it is no number, schedule or dotted name.
_READERS: tuple[tuple[Any, Callable[[Any, Any, str], Any]], ...] = (
    (types.NoneType, _read_none),
    (Literal, _read_choice),
    (bool, _read_bool),
    (int, _read_int),
    (float, _read_float),
    (Callable, _read_schedule),
    (type, _read_dotted_class),
    (str, _read_text),
    (type, _read_class),
    (dict, _read_mapping),
    (list, _read_list),
    (tuple, _read_tuple),
)

_KINDS: Mapping[Any, Any] = {
    **{kind: kind for kind, _ in _READERS},
    None: types.NoneType,
    collections.abc.Mapping: dict,
    collections.abc.Sequence: list,
}

_DESCRIPTIONS: Mapping[Any, str] = {
    types.NoneType: "null",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    Callable: "a schedule such as lin_0.001",
    type: "the name of a class",
    str: "a text",
    dict: "a mapping of names to values",
    list: "a list",
    tuple: "a list",
}
