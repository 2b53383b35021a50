"""What YAML documents may hold, and how much: the loaders of `pipeline.settings.strict_yaml`.

What a document stands for is counted while it is read, what is shared at each of its places: a few
lines cannot stand for more than the memory holds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import yaml
from yaml.constructor import ConstructorError
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from pipeline.errors import shown, visible

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
