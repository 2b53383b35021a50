"""Reads strict YAML: plain data only, no repeated keys, and errors with a line number.

It differs from `yaml.safe_load` in three ways: a repeated key is an error, dates and other tags
stay text or are refused, and ``1e-4`` is a number, as in YAML 1.2, not a text.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from copy import deepcopy
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from rl_yardstick.pipeline.errors import UserError, shown, visible
from rl_yardstick.safe_files.files import UnsafeFileError, read_file

# Far more than settings need, but read in well under a second.
_MAX_BYTES = 256 * 1024
_MAX_DEPTH = 50
_MAX_VALUES = 20_000
_LONGEST_NUMBER = 100  # characters; reading sexagesimal numbers takes quadratic time

_TAG = "tag:yaml.org,2002:"
_PLAIN_TAGS = frozenset(
    _TAG + name for name in ("null", "bool", "int", "float", "str", "seq", "map")
)
# The tag in the settings that rl_zoo3 writes.
_ORDERED_DICT = _TAG + "python/object/apply:collections.OrderedDict"


def _refusal(problem: str, mark: yaml.Mark) -> ConstructorError:
    return ConstructorError(None, None, problem, mark)


def _too_much(mark: yaml.Mark) -> ConstructorError:
    return _refusal("is nested too deeply, or too large", mark)


class StrictLoader(yaml.SafeLoader):
    """Refuses repeated keys, tags other than plain data, and documents that are too large."""

    admitted_tags = _PLAIN_TAGS
    admits_control_characters = False

    yaml_implicit_resolvers = {  # noqa: RUF012 # PyYAML copies it itself before it adds to it
        first: [(tag, regexp) for tag, regexp in resolvers if tag != _TAG + "timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, content: str | bytes) -> None:
        super().__init__(content)
        self._n_values = 0  # so far; shared values count at each of their places
        self._open: list[int] = []  # number of values before each open node
        self._sizes: dict[int, tuple[int, int]] = {}  # values and depth of each node, by its id

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        untyped: Any = self
        event = untyped.peek_event()
        mark: Any = event.start_mark
        if len(self._open) >= _MAX_DEPTH:
            raise _too_much(mark)
        self._open.append(self._n_values)
        if not isinstance(event, AliasEvent):
            self._n_values += 1
        node = super().compose_node(parent, index)
        before = self._open.pop()
        if not isinstance(event, AliasEvent):
            levels = 1
            if not isinstance(node, ScalarNode):
                levels += max((self._sizes[id(part)][1] for part in _parts(node)), default=0)
            self._sizes[id(node)] = self._n_values - before, levels
        elif id(node) in self._sizes:
            self._n_values += self._sizes[id(node)][0]
        else:  # it contains its own alias
            raise _too_much(mark)
        around = self._open[-1] if self._open else self._n_values
        level = len(self._open) + self._sizes[id(node)][1]
        if self._n_values - around > _MAX_VALUES or level > _MAX_DEPTH:
            raise _too_much(mark)
        return node

    def compose_mapping_node(self, anchor: dict[Any, Node]) -> MappingNode:
        # Checked before merge keys (<<) add keys of other mappings.
        node = super().compose_mapping_node(anchor)
        first_lines: dict[str, int] = {}
        for key in (key for key, _ in node.value if isinstance(key, ScalarNode)):
            if key.value in first_lines:
                first = first_lines[key.value]
                problem = f"key {shown(key.value)} appears twice, first on line {first}"
                raise _refusal(problem, key.start_mark)
            first_lines[key.value] = key.start_mark.line + 1
        return node

    def construct_object(self, node: Node, deep: bool = False) -> Any:
        text = node.value if isinstance(node, ScalarNode) else ""
        is_number = node.tag in (_TAG + "int", _TAG + "float")
        if node.tag not in self.admitted_tags:
            problem = f"{node.tag.replace(_TAG, '!!')} is not allowed here"
        elif not self.admits_control_characters and visible(text) != text:
            # YAML refuses raw ones; escaped ones would reach tables, pictures and file names.
            problem = f"{shown(text)} holds control characters"
        elif is_number and len(node.value) > _LONGEST_NUMBER:
            problem = f"{shown(node.value)} is too long for a number"
        else:
            try:
                return super().construct_object(node, deep)
            except (ValueError, LookupError):
                problem = f"{shown(node.value)} is no {node.tag.removeprefix(_TAG)}"
        raise _refusal(problem, node.start_mark)


StrictLoader.add_implicit_resolver(
    _TAG + "float", re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"), "-+0123456789"
)


class SavedSettingsLoader(StrictLoader):
    """Accepts rl_zoo3's tag for an OrderedDict, and control characters in folder names."""

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
    raise _refusal("is no OrderedDict of different keys, as rl_zoo3 writes it", node.start_mark)


SavedSettingsLoader.add_constructor(_ORDERED_DICT, _ordered_dict)


def parse_yaml(content: str | bytes, where: str, loader: type[StrictLoader] = StrictLoader) -> Any:
    """Read one YAML document."""
    if len(content) > _MAX_BYTES:
        raise UserError(f"{where}: is larger than {_MAX_BYTES:,} bytes")
    try:
        loader_class: Any = loader  # for mypy, classes are not hashable
        return deepcopy(_load(content, loader_class))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        raise UserError(f"{where}{place}: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise UserError(f"{where}: is not a text file, or holds control characters") from error
    except (RecursionError, ValueError) as error:
        raise UserError(f"{where}: is nested too deeply, or too large") from error


@lru_cache(maxsize=32)  # a study reads the same entries repeatedly
def _load(content: str | bytes, loader_class: Any) -> Any:
    return yaml.load(content, loader_class)  # noqa: S506  # a subclass of SafeLoader


def read_yaml(path: Path) -> Any:
    """Read the only YAML document in a file."""
    return parse_yaml(settings_bytes(path), str(path))


def read_saved_settings(path: Path) -> dict[str, Any]:
    """Read the settings in a run folder of this project or rl_zoo3."""
    value = parse_yaml(settings_bytes(path), str(path), SavedSettingsLoader)
    if not (isinstance(value, dict) and all(isinstance(key, str) for key in value)):
        raise UserError(f"{path}: must map names to values")
    return value


def settings_bytes(path: Path) -> bytes:
    """Read a whole settings file."""
    try:
        return read_file(path, _MAX_BYTES)
    except UnsafeFileError as error:
        raise UserError(str(error)) from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{path}: cannot be read: {reason}") from error


def key_lines(path: Path) -> dict[tuple[str | int, ...], int]:
    """The line numbers, from 1, of the values in a file, by their key paths."""
    node = yaml.compose(settings_bytes(path), StrictLoader)
    return {} if node is None else dict(_node_lines(node, ()))


def _node_lines(
    node: Node, keys: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], int]]:
    yield keys, node.start_mark.line + 1
    if isinstance(node, MappingNode):
        for key, value in node.value:
            inner = (*keys, str(key.value))
            yield from _node_lines(value, inner)
            # The line of the key, not of its value.
            yield inner, key.start_mark.line + 1
    elif isinstance(node, SequenceNode):
        for index, value in enumerate(node.value):
            yield from _node_lines(value, (*keys, index))


def _parts(node: Any) -> Iterable[Node]:
    return chain.from_iterable(node.value) if isinstance(node, MappingNode) else node.value
