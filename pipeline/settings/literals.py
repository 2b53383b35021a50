"""Values written as Python literals, read without ever running them.

The text is parsed to a syntax tree, and the tree is rebuilt from a short list of node types. A
dotted name stays a name: `pipeline.settings.components` decides what it may stand for.
"""

from __future__ import annotations

import ast
import contextlib
import shlex
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.errors import UserError, one_line, shown
from pipeline.settings.strict_yaml import parse_yaml

# A deeper or longer expression than this is no hyperparameter, and could exhaust the parser.
_MAX_CHARACTERS = 10_000


@dataclass(frozen=True)
class DottedName:
    """The name of a class, such as ``nn.Tanh``, not looked up yet."""

    name: str

    def __str__(self) -> str:
        return self.name


class _RefusedError(Exception):
    """A part of the syntax tree that is not a literal."""

    def __init__(self, what: str, node: ast.AST) -> None:
        super().__init__(what)
        self.what = what
        self.node = node


def parse_literal(text: str, where: str = "") -> Any:
    """Read a literal: ``"[64, 64]"``, ``"{'a': 1}"``, ``"dict(net_arch=[64], act=nn.Tanh)"``.

    Args:
        text: a number, text, True, False, None, list, tuple or dictionary, in Python's spelling;
            ``dict(...)``, ``list(...)`` and ``tuple(...)`` stand for their contents.
        where: what the text belongs to, for error messages.

    Returns:
        The value; names of classes in it are `DottedName`.

    Raises:
        UserError: if the text is anything else, saying at which column.
    """
    text = text.strip()
    try:
        return _convert(_parse(text))
    except SyntaxError as error:
        line, column = error.lineno or 1, error.offset or 1
        what = f"invalid syntax ({error.msg})"
    except _RefusedError as error:
        line, column, what = *_position(text, error.node), error.what
    except (ValueError, RecursionError, MemoryError) as error:
        line, column, what = 1, 1, f"cannot be read ({one_line(error)})"
    place = f"line {line}, column {column}" if "\n" in text else f"column {column}"
    raise UserError(f"{where + ': ' if where else ''}{shown(text)}, {place}: {what}")


def contains_name(value: object) -> bool:
    """Whether a `DottedName` stands anywhere in nested lists, tuples and dictionaries."""
    if isinstance(value, dict):
        return any(map(contains_name, value.values()))
    if isinstance(value, list | tuple):
        return any(map(contains_name, value))
    return isinstance(value, DottedName)


def parse_assignments(assignments: Iterable[str], where: str = "") -> dict[str, Any]:
    """Read what ``-params`` and ``--env-kwargs`` take: a list of ``key:value``.

    Args:
        assignments: such as ``learning_rate:0.01``, ``policy_kwargs:"dict(net_arch=[64])"``,
            ``desc:map.txt`` or ``is_slippery:false``.
        where: the option that they belong to, for error messages.

    Returns:
        The values by key. A value is a literal in Python's or YAML's spelling, or else text; text
        also where the names of classes stand in it, since it goes into the run folder as it is.

    Raises:
        UserError: if one has no key, no value, or a key that came before.
    """
    prefix = f"{where}: " if where else ""
    result: dict[str, Any] = {}
    words = list(assignments)
    for place, assignment in enumerate(words):
        key, colon, value = assignment.partition(":")
        if not (colon and key.isidentifier() and value.strip()):
            raise UserError(
                f"{prefix}{shown(assignment)} does not have the form key:value"
                f"{_meant(words[place:])}"
            )
        if key in result:
            raise UserError(f"{prefix}{shown(key)} is given twice")
        result[key] = _value_or_text(value)
    return result


def _meant(words: Sequence[str]) -> str:
    """A hint at what ``key=value``, ``key value``, ``key = value`` or ``key: value`` should be."""
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
    # [SFFF, FFFG] and false are literals in YAML only, and in a file they would be read as such.
    with contextlib.suppress(UserError):
        value = parse_yaml(text, "")
        is_collection = isinstance(value, list | dict) and text.lstrip().startswith(("[", "{"))
        if value is None or isinstance(value, bool) or is_collection:
            return value
    return text


def _parse(text: str) -> ast.expr:
    if len(text) > _MAX_CHARACTERS:
        raise ValueError(f"longer than {_MAX_CHARACTERS} characters")
    with warnings.catch_warnings():
        # An unknown escape such as "\d" is left as the user wrote it.
        warnings.simplefilter("ignore")
        return ast.parse(text, mode="eval").body


def _position(text: str, node: ast.AST) -> tuple[int, int]:
    """Line and column, counted from 1; the tree counts columns in bytes."""
    line, offset = getattr(node, "lineno", 1), getattr(node, "col_offset", 0)
    before = text.splitlines()[line - 1].encode()[:offset].decode(errors="replace")
    return line, len(before) + 1


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
        case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
            return _convert_signed(node)
        case ast.Call(func=ast.Name(id="dict"), args=[]):
            keys = [keyword.arg and ast.Constant(keyword.arg) for keyword in node.keywords]
            return _convert_dict(node, keys, [keyword.value for keyword in node.keywords])
        case ast.Call(func=ast.Name(id="list" | "tuple" as name), args=[argument], keywords=[]):
            return _convert_sequence(argument, list if name == "list" else tuple)
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


def _convert_signed(node: ast.UnaryOp) -> int | float:
    number = _convert(node.operand)
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise _RefusedError("a sign needs a number", node)
    return -number if isinstance(node.op, ast.USub) else number


def _convert_sequence(node: ast.expr, kind: type[list[Any]] | type[tuple[Any, ...]]) -> Any:
    items = _convert(node)
    if not isinstance(items, list | tuple):
        raise _RefusedError(f"{kind.__name__}(...) needs a list or tuple", node)
    return kind(items)


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
