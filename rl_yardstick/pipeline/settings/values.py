"""Reads values from files and command lines as literals, and converts them to argument types.

Text is never executed: it is parsed to a syntax tree, and values are rebuilt from a short list of
node types. A dotted name stays a name; `pipeline.settings.components` decides what it may refer to.
An integer may be written as 1e6, a number as a text, a tuple as a list, a class by its name, a
schedule as ``lin_0.001``. A value that fits none of an argument's types is an error.
"""

from __future__ import annotations

import ast
import collections.abc
import contextlib
import inspect
import math
import re
import shlex
import sys
import types
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from types import MappingProxyType
from typing import Any, Literal, Union, get_args, get_origin

from rl_yardstick.pipeline.errors import UserError, did_you_mean, one_line, shown, unknown
from rl_yardstick.pipeline.settings.yaml import parse_yaml

_MAX_CHARACTERS = 10_000


@dataclass(frozen=True)
class DottedName:
    """A class name such as ``nn.Tanh``, not looked up yet."""

    name: str

    def __str__(self) -> str:
        return self.name


class _RefusedError(Exception):
    """A refused part of a syntax tree; arguments: the reason, and the part."""


def parse_literal(text: str, where: str = "") -> Any:
    """Read a literal: ``"[64, 64]"``, ``"{'a': 1}"``, ``"dict(net_arch=[64], act=nn.Tanh)"``."""
    text = text.strip()
    try:
        # A deeper or longer expression is not a hyperparameter, and could exhaust the parser.
        if len(text) > _MAX_CHARACTERS:
            raise ValueError(f"longer than {_MAX_CHARACTERS} characters")
        with warnings.catch_warnings(action="ignore"):  # keeps unknown escapes such as "\d"
            tree = ast.parse(text, mode="eval").body
        return _convert(tree)
    except SyntaxError as error:
        line, column = error.lineno or 1, error.offset or 1
        what = f"invalid syntax ({error.msg})"
    except _RefusedError as error:
        what, node = error.args
        # The tree counts columns in bytes.
        line, offset = getattr(node, "lineno", 1), getattr(node, "col_offset", 0)
        before = text.splitlines()[line - 1].encode()[:offset].decode(errors="replace")
        column = len(before) + 1
    except (ValueError, RecursionError, MemoryError) as error:
        line, column, what = 1, 1, f"cannot be read ({one_line(error)})"
    place = f"line {line}, column {column}" if "\n" in text else f"column {column}"
    raise UserError(f"{where + ': ' if where else ''}{shown(text)}, {place}: {what}")


def contains_name(value: object) -> bool:
    """Whether nested lists, tuples and dictionaries contain a `DottedName`."""
    if isinstance(value, dict):
        return any(map(contains_name, value.values()))
    if isinstance(value, list | tuple):
        return any(map(contains_name, value))
    return isinstance(value, DottedName)


def parse_assignments(assignments: Iterable[str], where: str = "") -> dict[str, Any]:
    """Read the values of ``-params`` and ``--env-kwargs``: a list of ``key:value``.

    A value is a literal in Python's or YAML's spelling, or else text. A value with class names
    stays text, because it is written to the run folder unchanged.
    """
    prefix = f"{where}: " if where else ""
    result: dict[str, Any] = {}
    words = list(assignments)
    for place, assignment in enumerate(words):
        key, colon, value = assignment.partition(":")
        if not (colon and key.isidentifier() and value.strip()):
            what = f"{shown(assignment)} does not have the form key:value"
            raise UserError(f"{prefix}{what}{_meant(words[place:])}")
        if key in result:
            raise UserError(f"{prefix}{shown(key)} is given twice")
        result[key] = _value_or_text(value)
    return result


def _meant(words: Sequence[str]) -> str:
    """A hint for ``key=value``, ``key value``, ``key = value`` and ``key: value``."""
    key, *others = [*words[0].split("=", 1), *words[1:3]]
    key = key.rstrip(":")
    value = next(filter(None, (other.lstrip("=") for other in others)), "")
    if not (key.isidentifier() and value) or ":" in value:
        return ""
    return f": did you mean {shlex.quote(f'{key}:{value}')}?"


def _value_or_text(text: str) -> Any:
    with contextlib.suppress(UserError):
        value = parse_literal(text)
        if not contains_name(value):
            return value
    # YAML has more literals, such as [SFFF, FFFG] and false.
    with contextlib.suppress(UserError):
        value = parse_yaml(text, "")
        is_collection = isinstance(value, list | dict) and text.lstrip().startswith(("[", "{"))
        if value is None or isinstance(value, bool) or is_collection:
            return value
    return text


def _convert(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() | None as value):
            return value
        case ast.List():
            return [_convert(item) for item in node.elts]
        case ast.Tuple():
            return tuple(_convert(item) for item in node.elts)
        case ast.Dict():
            return _convert_dict(node, node.keys, node.values)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            number = _convert(operand)
            if isinstance(number, bool) or not isinstance(number, int | float):
                raise _RefusedError("a sign needs a number", node)
            return -number if isinstance(node.op, ast.USub) else number
        case ast.Call(func=ast.Name(id="dict"), args=[]):
            keys = [keyword.arg and ast.Constant(keyword.arg) for keyword in node.keywords]
            return _convert_dict(node, keys, [keyword.value for keyword in node.keywords])
        case ast.Call(func=ast.Name(id="list" | "tuple" as name), args=[argument], keywords=[]):
            items = _convert(argument)
            if not isinstance(items, list | tuple):
                raise _RefusedError(f"{name}(...) needs a list or tuple", argument)
            return list(items) if name == "list" else tuple(items)
        case ast.Name() | ast.Attribute():
            return _convert_name(node)
    raise _RefusedError("is not a literal, dict(...) or the name of a class; nothing is run", node)


def _convert_dict(
    node: ast.expr, keys: Sequence[ast.expr | str | None], values: Sequence[ast.expr]
) -> dict[Any, Any]:
    result: dict[Any, Any] = {}
    for key_node, value in zip(keys, values, strict=True):
        if not isinstance(key_node, ast.expr):
            raise _RefusedError("** is not read here", node)
        key = _convert(key_node)
        if not (key is None or isinstance(key, str | int | float)):
            raise _RefusedError("a key must be a text or a number", key_node)
        if key in result:
            raise _RefusedError(f"key {shown(key)} appears twice", value)
        result[key] = _convert(value)
    return result


def _convert_name(node: ast.expr) -> DottedName:
    match node:
        case ast.Name(id=name):
            dotted = name
        case ast.Attribute(value=ast.Name() | ast.Attribute() as owner, attr=name):
            dotted = f"{_convert_name(owner)}.{name}"
        case _:
            raise _RefusedError("is not a dotted name; nothing is run", node)
    if name.startswith("_"):
        raise _RefusedError(f"{name} is private and not read", node)
    return DottedName(dotted)


_SCHEDULE = re.compile(r"([A-Za-z]+)_([-+.\d][^_]*)(?:_([^_]+))?")
_SCHEDULE_FORMS = "lin_START, lin_START_END and exp_START_END"
_CLASS_NAME = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*")


@dataclass(frozen=True)
class ScheduleSpec:
    """A schedule of a number, from ``start`` at the first step to ``end`` at the last."""

    # whether it changes by a constant amount per step, or by a constant factor
    kind: Literal["linear", "exponential"]
    start: float
    end: float


class _MisfitError(Exception):
    """A value does not fit one of an argument's types; another type may fit."""


def coerce(value: Any, annotation: Any, where: str) -> Any:
    """Convert a value by the first fitting option of a type; unknown types keep it unchanged."""
    options = _options(annotation)
    for kind, _, read in _READERS:
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
    """Read ``lin_0.001`` (to 0), ``lin_0.001_0.0001`` or ``exp_0.001_0.0001``."""
    match, start, end = _SCHEDULE.fullmatch(text), math.nan, math.nan
    with contextlib.suppress(ValueError):
        start, end = (float(part or "0") for part in match.group(2, 3)) if match else (start, end)
    if not match or match[1] not in {"lin", "exp"} or not all(map(math.isfinite, (start, end))):
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
    """The key of a type in `_READERS`, or None."""
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


def _read_as_it_is(value: Any, option: Any, where: str) -> Any:
    if not isinstance(value, _kind(option)):
        raise _MisfitError
    return value


def _read_choice(value: Any, option: Any, where: str) -> Any:
    for choice in get_args(option):
        if type(choice) is type(value) and choice == value:
            return choice
    raise _MisfitError


def _read_int(value: Any, option: Any, where: str) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    with contextlib.suppress(ValueError):
        # Exact, unlike a conversion through float.
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


def _read_schedule(value: Any, option: Any, where: str) -> ScheduleSpec:
    if isinstance(value, ScheduleSpec):
        return value
    if isinstance(value, str) and _SCHEDULE.fullmatch(value):
        return parse_schedule(value, where)
    raise _MisfitError


def _read_class(value: Any, option: Any, where: str, is_dotted: bool = False) -> DottedName:
    if isinstance(value, DottedName):
        return value
    if not (isinstance(value, str) and _CLASS_NAME.fullmatch(value)) or (
        is_dotted and "." not in value
    ):
        raise _MisfitError
    return DottedName(value)


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


# In this order: a value is a text if it is no number, schedule or dotted name.
_READERS: tuple[tuple[Any, str, Callable[[Any, Any, str], Any]], ...] = (
    (types.NoneType, "null", _read_as_it_is),
    (Literal, "one of several values", _read_choice),
    (bool, "true or false", _read_as_it_is),
    (int, "a whole number", _read_int),
    (float, "a number", _read_float),
    (Callable, "a schedule such as lin_0.001", _read_schedule),
    (type, "the name of a class", partial(_read_class, is_dotted=True)),
    (str, "a text", _read_as_it_is),
    (type, "the name of a class", _read_class),
    (dict, "a mapping of names to values", _read_mapping),
    (list, "a list", _read_list),
    (tuple, "a list", _read_tuple),
)
_DESCRIPTIONS = {kind: words for kind, words, _ in _READERS}
_KINDS: Mapping[Any, Any] = {
    **{kind: kind for kind in _DESCRIPTIONS},
    None: types.NoneType,
    collections.abc.Mapping: dict,
    collections.abc.Sequence: list,
}


_FINITE = sys.float_info.max
_LARGEST_WHOLE = 2**63 - 1
_STARRED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)

# Inclusive bounds of hyperparameters with the same meaning in every algorithm.
RANGES: Mapping[str, tuple[float, float]] = {
    "n_timesteps": (1, _FINITE),
    "n_episodes": (1, _FINITE),
    "n_envs": (1, _FINITE),
    "frame_stack": (1, _FINITE),
    "noise_std": (0, _FINITE),
    # Larger rates overflow single precision in the first update.
    "learning_rate": (0, 1e37),
    "gamma": (0, 1),
    "gae_lambda": (0, 1),
    "tau": (0, 1),
    "clip_range": (0, _FINITE),
    "clip_range_vf": (0, _FINITE),
    "exploration_fraction": (0, 1),
    "exploration_initial_eps": (0, 1),
    "exploration_final_eps": (0, 1),
    "temperature": (0, _FINITE),
    "batch_size": (1, _FINITE),
    "buffer_size": (1, _FINITE),
    "n_steps": (1, _FINITE),
    "n_epochs": (1, _FINITE),
    "learning_starts": (0, _FINITE),
    "train_freq": (1, _FINITE),
    # -1 means once per environment step, or never.
    "gradient_steps": (-1, _FINITE),
    "sde_sample_freq": (-1, _FINITE),
    "target_update_interval": (1, _FINITE),
    "max_grad_norm": (0, math.inf),
    "vf_coef": (0, _FINITE),
    "rms_prop_eps": (0, _FINITE),
    "target_kl": (0, _FINITE),
    "stats_window_size": (1, _FINITE),
}


def constructor_parameters(cls: type) -> Mapping[str, inspect.Parameter]:
    """The arguments of a class's constructor, with resolved annotations where possible."""
    try:
        return inspect.signature(cls, eval_str=True).parameters
    except (NameError, AttributeError, TypeError, SyntaxError):
        # A name that only type checkers import; unresolved annotations are not checked.
        return inspect.signature(cls).parameters


@cache  # a run calls it six times, and reading signatures is slow
def algorithm_parameters(cls: type) -> Mapping[str, inspect.Parameter]:
    """A constructor's arguments, including those that ``**kwargs`` may pass to base classes."""
    own = dict(constructor_parameters(cls))
    rest = next((p for p in own.values() if p.kind is p.VAR_KEYWORD), None)
    owners = [base for base in cls.__mro__[:-1] if "__init__" in vars(base)]
    if rest is not None and len(owners) > 1:
        named = {name: p for name, p in own.items() if p.kind not in _STARRED}
        own = {**algorithm_parameters(owners[1]), **named, rest.name: rest}
        if "env" in named and "policy" not in named:
            own.pop("policy", None)  # the constructor passes it itself
    for name, parameter in own.items():
        if set(get_args(parameter.annotation)) == {float, Callable}:
            # sb3-contrib's TQC annotates a schedule as a bare function.
            own[name] = parameter.replace(annotation=float | Callable[[float], float])
        elif parameter.annotation is parameter.empty and type(parameter.default) in (int, float):
            kind = (
                int | float if type(parameter.default) is int else float | Callable[[float], float]
            )
            own[name] = parameter.replace(annotation=kind | Any)
    return MappingProxyType(own)


def check_arguments(
    kwargs: Mapping[str, Any],
    parameters: Mapping[str, inspect.Parameter],
    where: str,
    what: str = "argument",
    also_known: Iterable[str] = (),
) -> dict[str, Any]:
    """Check arguments by name and type."""
    admits_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    result = {}
    for name, value in kwargs.items():
        if name not in parameters and not admits_any:
            raise unknown(f"{where}: unknown {what}", name, [*parameters, *also_known])
        annotation = parameters[name].annotation if name in parameters else Any
        result[name] = coerce(value, annotation, f"{where}: {name}")
    return result


def check_range(name: str, value: object, where: str) -> None:
    """Refuse a number, or an end of a schedule, outside `RANGES` or too large for an array."""
    if isinstance(value, ScheduleSpec):
        check_range(name, value.start, where)
        check_range(name, value.end, where)
    if isinstance(value, tuple) and value:
        check_range(name, value[0], where)
    if isinstance(value, int) and abs(value) > _LARGEST_WHOLE:
        raise UserError(f"{where}: {name} must be at most {_LARGEST_WHOLE:,}, not {shown(value)}")
    if name in RANGES and isinstance(value, int | float):
        low, high = RANGES[name]
        if not low <= value <= high:
            bounds = f"at least {low}" if high >= _FINITE else f"between {low} and {high}"
            finite = " and finite" if value > high >= _FINITE else ""
            raise UserError(f"{where}: {name} must be {bounds}{finite}, not {shown(value)}")
