"""YAML without surprises: plain data only, no key twice, and errors that say where.

Beside `yaml.safe_load`, three things differ: a repeated key is refused instead of winning silently,
dates and other tags stay what they look like or are refused, and ``1e-4`` is a number, as YAML 1.2
has it, not a text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from pipeline.errors import UserError, shown, visible
from safe_files.files import UnsafeFileError, read_file

# Twenty times what the longest file of settings has, and read in well under a second.
_MAX_BYTES = 256 * 1024


def parse_yaml(content: str | bytes, where: str) -> Any:
    """Read one YAML document."""
    return _parse(content, where, StrictLoader)


def _parse(content: str | bytes, where: str, loader: type[StrictLoader]) -> Any:
    if len(content) > _MAX_BYTES:
        raise UserError(f"{where}: is larger than {_MAX_BYTES:,} bytes")
    try:
        loader_class: Any = loader  # mypy takes no class for hashable
        return deepcopy(_load(content, loader_class))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        raise UserError(f"{where}{place}: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise UserError(f"{where}: is not a text file, or holds control characters") from error
    except (RecursionError, ValueError) as error:
        raise UserError(f"{where}: is nested too deeply, or too large") from error


def read_yaml(path: Path) -> Any:
    """Read the one YAML document in a file; see `parse_yaml`."""
    return _parse(_content(path), str(path), StrictLoader)


def read_saved_settings(path: Path) -> dict[str, Any]:
    """Read the settings that a run folder keeps, ours or rl_zoo3's; see `parse_yaml`.

    rl_zoo3 writes them as an OrderedDict with the name of its class, the one tag that is admitted.
    """
    value = _parse(_content(path), str(path), SavedSettingsLoader)
    if not (isinstance(value, dict) and all(isinstance(key, str) for key in value)):
        raise UserError(f"{path}: must map names to values")
    return value


def _content(path: Path) -> bytes:
    try:
        return read_file(path, _MAX_BYTES)
    except UnsafeFileError as error:
        raise UserError(str(error)) from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{path}: cannot be read: {reason}") from error


def read_settings_text(path: Path) -> str:
    """The text of a file of settings, for what needs no more than a look at it."""
    try:
        return _content(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not a text file, or holds control characters") from error


def key_lines(path: Path) -> dict[tuple[str | int, ...], int]:
    """The line on which each value of a file stands, for messages about what it means.

    Args:
        path: a file that `read_yaml` has read.

    Returns:
        Line numbers, counted from 1, by the keys and indexes that lead to the value.
    """
    loader = StrictLoader(_content(path))
    try:
        node = loader.get_single_node()
        return {} if node is None else dict(_node_lines(node, ()))
    finally:
        loader.dispose()


def _node_lines(
    node: Node, keys: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], int]]:
    yield keys, node.start_mark.line + 1
    if isinstance(node, MappingNode):
        for key, value in node.value:
            inner = (*keys, str(key.value))
            yield from _node_lines(value, inner)
            # Where the key stands, and not where its value begins.
            yield inner, key.start_mark.line + 1
    elif isinstance(node, SequenceNode):
        for index, value in enumerate(node.value):
            yield from _node_lines(value, (*keys, index))


@lru_cache(maxsize=32)  # a study asks for the same entries again and again
def _load(content: str | bytes, loader_class: Any) -> Any:
    loader = loader_class(content)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


_TAG = "tag:yaml.org,2002:"
_PLAIN_TAGS = frozenset(
    _TAG + name for name in ("null", "bool", "int", "float", "str", "seq", "map")
)
# How rl_zoo3 writes the settings of a run.
_ORDERED_DICT = _TAG + "python/object/apply:collections.OrderedDict"
# Far more than settings need, and read in well under a second.
_MAX_DEPTH = 50
_MAX_VALUES = 20_000
_LONGEST_NUMBER = 100  # characters; the time that sexagesimal numbers take grows with the square


@dataclass
class _Count:
    """What a node stands for, what is shared counted at each place: values, and levels of them."""

    values: int = 1
    depth: int = 1


def _too_much(mark: yaml.Mark) -> ConstructorError:
    return ConstructorError(None, None, "is nested too deeply, or too large", mark)


class StrictLoader(yaml.SafeLoader):
    """Refuses repeated keys and every tag but those of plain data."""

    admitted_tags = _PLAIN_TAGS
    admits_control_characters = False

    yaml_implicit_resolvers = {  # noqa: RUF012 # PyYAML copies it itself before it adds to it
        first: [(tag, regexp) for tag, regexp in resolvers if tag != _TAG + "timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, content: str | bytes) -> None:
        super().__init__(content)
        self._counts: dict[int, _Count] = {}  # by the node's id
        self._open: list[_Count] = []  # of the nodes that are being read, the outermost first

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        untyped: Any = self
        event = untyped.peek_event()
        if len(self._open) >= _MAX_DEPTH:
            raise _too_much(event.start_mark)
        self._open.append(_Count())
        node = super().compose_node(parent, index)
        count = self._open.pop()
        if isinstance(event, AliasEvent):
            # Not counted yet is a node that holds its own alias.
            count = self._counts.get(id(node), _Count(_MAX_VALUES))
        self._counts[id(node)] = count
        if self._open:
            around = self._open[-1]
            around.values += count.values
            around.depth = max(around.depth, 1 + count.depth)
            if around.values > _MAX_VALUES or len(self._open) + count.depth > _MAX_DEPTH:
                raise _too_much(event.start_mark)
        return node

    def compose_mapping_node(self, anchor: dict[Any, Node]) -> MappingNode:
        # Here, and not where the mapping is built: by then merged keys stand among its own.
        node = super().compose_mapping_node(anchor)
        first_lines: dict[str, int] = {}
        for key in (key for key, _ in node.value if isinstance(key, ScalarNode)):
            if key.value in first_lines:
                first = first_lines[key.value]
                problem = f"key {shown(key.value)} appears twice, first on line {first}"
                raise ConstructorError(None, None, problem, key.start_mark)
            first_lines[key.value] = key.start_mark.line + 1
        return node

    def construct_object(self, node: Node, deep: bool = False) -> Any:
        if node.tag not in self.admitted_tags:
            problem = f"{node.tag.replace(_TAG, '!!')} is not allowed here"
            raise ConstructorError(None, None, problem, node.start_mark)
        text = node.value if isinstance(node, ScalarNode) else ""
        if not self.admits_control_characters and visible(text) != text:
            # As itself none is YAML. Spelt out, it would go on into tables, pictures and names.
            problem = f"{shown(text)} holds control characters"
            raise ConstructorError(None, None, problem, node.start_mark)
        is_number = node.tag in (_TAG + "int", _TAG + "float")
        if is_number and len(node.value) > _LONGEST_NUMBER:
            problem = f"{shown(node.value)} is too long for a number"
            raise ConstructorError(None, None, problem, node.start_mark)
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError) as error:
            problem = f"{shown(node.value)} is no {node.tag.removeprefix(_TAG)}"
            raise ConstructorError(None, None, problem, node.start_mark) from error


StrictLoader.add_implicit_resolver(
    _TAG + "float", re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"), "-+0123456789"
)


class SavedSettingsLoader(StrictLoader):
    """Reads rl_zoo3's tag for an OrderedDict too: as the data that it is, looking nothing up.

    A folder's name among the settings may be whatever it was.
    """

    admitted_tags = _PLAIN_TAGS | {_ORDERED_DICT}
    admits_control_characters = True


def _ordered_dict(loader: SavedSettingsLoader, node: Node) -> dict[str, Any]:
    arguments = loader.construct_sequence(node, deep=True) if isinstance(node, SequenceNode) else 0
    match arguments:
        case [] | [[]]:
            return {}
        case [list(pairs)] if all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
            keys = [key for key, _ in pairs]
            if all(isinstance(key, str) for key in keys) and len(set(keys)) == len(keys):
                return dict(pairs)
    problem = "is no OrderedDict of different keys, as rl_zoo3 writes it"
    raise ConstructorError(None, None, problem, node.start_mark)


SavedSettingsLoader.add_constructor(_ORDERED_DICT, _ordered_dict)
