"""From data to objects: those that are there are filled in place, the rest is made anew."""

from __future__ import annotations

import os
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snapshots.derived_types import as_derived, empty_of
from snapshots.filling import (
    NotRestorableError,
    fill_array,
)
from snapshots.functions import fill_function, fill_method
from snapshots.kinds import find, hides_state, is_transient, left_out, likeness, name_of, slots
from snapshots.leaf_filling import MISSING, LeafFiller
from snapshots.recording import REFERENCE, Snapshot
from snapshots.shared_memory import is_view, view_at


def restore(
    snapshot: Snapshot, roots: dict[str, Any], moved: Mapping[str, str] | None = None
) -> None:
    """Fill objects with what was recorded of others of the same build.

    Args:
        snapshot: the record. It loses its arrays on the way, so that no buffer is there twice.
        roots: the objects to fill, by the names that they were recorded under.
        moved: folders that have another name by now; texts that begin with one are changed.

    Raises:
        NotRestorableError: if they are of another build; some are filled by then.
    """
    restorer = _Restorer(snapshot, moved or {})
    for name, existing in roots.items():
        try:
            found = restorer.value(snapshot.roots[name], existing)
        except (NotRestorableError, MemoryError):
            raise
        except Exception as error:  # objects may raise anything where they are filled
            raise restorer.missing(f"what fits ({type(error).__name__}: {error})") from error
        if found is not existing:
            raise NotRestorableError(f"{name} is not what was recorded")


class _Restorer(LeafFiller):
    def __init__(self, snapshot: Snapshot, moved: Mapping[str, str]) -> None:
        self._snapshot = snapshot
        self._moved = moved
        self._done: dict[int, Any] = {}
        self._path: list[str] = []
        # By id, which stays theirs as long as they are held here.
        self._claimed: dict[int, Any] = {}

    def value(self, cell: Any, existing: Any = MISSING) -> Any:
        """The value that a cell stands for; ``existing`` itself where it can be filled."""
        if isinstance(cell, str):
            return self._text(cell)
        if not isinstance(cell, list):
            return cell
        mark, content = cell
        if mark != REFERENCE:
            return float(content)
        if content not in self._done:
            node = self._snapshot.nodes[content]
            # What were two objects must not become one.
            is_taken = id(existing) in self._claimed and node["kind"] != "constant"
            self._claimed[id(existing)] = existing
            self._done[content] = self._filled(content, node, MISSING if is_taken else existing)
        return self._done[content]

    def _filled(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        fill = _FILLERS[node["kind"]]
        if node["kind"] == "object" or "attributes" not in node:
            return fill(self, number, node, existing)
        kind = self.class_of(node, existing)
        if type(existing) is not kind:
            existing = empty_of(kind, node)
        filled = as_derived(fill(self, number, node, existing), kind)
        self._done[number] = filled
        self._fill_attributes(node, filled)
        return filled

    def _text(self, text: str) -> str:
        for before, now in self._moved.items():
            if text == before or text.startswith(before + os.sep):
                return now + text[len(before) :]
        return text

    def missing(self, what: str) -> NotRestorableError:
        return NotRestorableError(f"{what} is missing in {'.'.join(self._path) or 'it'}")

    def values(self, cells: list[Any], existing: Any = ()) -> list[Any]:
        found = list(existing)
        known = found + [MISSING] * (len(cells) - len(found))
        return [self.value(cell, old) for cell, old in zip(cells, known, strict=False)]

    def held(self, node: dict[str, Any]) -> NDArray[Any]:
        arrays, number = self._snapshot.arrays, int(node["array"])
        array, arrays[number] = arrays[number], np.empty(0)
        return array

    def class_of(self, node: dict[str, Any], existing: Any) -> Any:
        """The class that a node names: that of what is there, or one that is imported already."""
        if name_of(type(existing)) == node["class"]:
            return type(existing)
        found = find(node["class"])
        if not isinstance(found, type):
            raise self.missing(f"the class {node['class']}")
        return found

    def _constant(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        if node["class"] and name_of(existing) != node["class"]:
            found = find(node["class"])
            if found is not None:
                return found
        if existing is MISSING or node["like"] not in ("", likeness(existing)):
            raise self.missing(node["class"] or node["like"].strip() or "a part")
        return existing

    def _object(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self.class_of(node, existing)
        if type(existing) is not kind:
            if hides_state(kind):
                raise self.missing(node["class"])
            existing = object.__new__(kind)
        self._done[number] = existing
        self._fill_attributes(node, existing)
        return existing

    def _fill_attributes(self, node: dict[str, Any], existing: Any) -> None:
        kind = type(existing)
        skipped = left_out(kind)
        attributes = dict(node["attributes"])
        inside, in_slots = getattr(existing, "__dict__", {}), set(slots(kind))
        for name in set(inside) - attributes.keys() - skipped:
            if not is_transient(inside[name]):
                del inside[name]
        for name, cell in attributes.items():
            self._path.append(name)
            if name in in_slots:
                new = self.value(cell, getattr(existing, name, MISSING))
                object.__setattr__(existing, name, new)
            else:
                inside[name] = self.value(cell, inside.get(name, MISSING))
            self._path.pop()

    def _dict(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self.class_of(node, existing)
        if type(existing) is not kind:
            if kind not in (dict, OrderedDict, defaultdict, Counter):
                raise self.missing(node["class"])
            existing = kind()
        self._done[number] = existing
        if "factory" in node:
            existing.default_factory = self.value(node["factory"], existing.default_factory)
        before = dict(existing)
        keys = [*before, *[MISSING] * len(node["items"])]
        existing.clear()
        for (key_cell, cell), old_key in zip(node["items"], keys, strict=False):
            key = self.value(key_cell, old_key)
            existing[key] = self.value(cell, before.get(key, MISSING))
        return existing

    def _list(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        result = existing if isinstance(existing, list) else []
        self._done[number] = result
        before = list(result)
        result[:] = self.values(node["items"], before)
        return result

    def _elsewhere(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return existing if isinstance(existing, list) else []

    def _numbers(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        result = existing if isinstance(existing, list) else []
        result[:] = self.held(node).tolist()
        return result

    def _tuple(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self.class_of(node, existing)
        before = existing if isinstance(existing, tuple) else ()
        values = self.values(node["items"], before)
        is_same = type(existing) is kind and len(before) == len(values)
        if is_same and all(new is old for new, old in zip(values, before, strict=True)):
            return existing
        if not issubclass(kind, tuple):
            raise self.missing(node["class"])
        return tuple.__new__(kind, values)

    def _set(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        values = self.values(node["items"])
        if node["kind"] == "frozenset":
            is_same = isinstance(existing, frozenset) and list(existing) == values
            return existing if is_same else frozenset(values)
        result = existing if isinstance(existing, set) else set()
        if list(result) == values:  # it keeps its order, whatever that came of
            return result
        result.clear()
        result.update(values)
        return result

    def _deque(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        is_same = isinstance(existing, deque) and existing.maxlen == node["longest"]
        result = existing if is_same else deque(maxlen=node["longest"])
        self._done[number] = result
        before = list(result)
        result.clear()
        result.extend(self.values(node["items"], before))
        return result

    def _ndarray(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        # What has a memory of its own must not write into what another looks at.
        is_others = node["is_owner"] and is_view(existing)
        if node["writeable"] and isinstance(existing, np.ndarray):
            is_others = is_others or not existing.flags.writeable
        axes = node["axes"]
        held = self.held(node).transpose([axes.index(axis) for axis in range(len(axes))])
        return fill_array(held, MISSING if is_others else existing)

    def _view(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        base = self.value(node["base"], existing.base if is_view(existing) else MISSING)
        return view_at(base, self.held(node).dtype, node, existing)

    def _function(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        try:
            function = fill_function(node, existing)
        except LookupError as error:
            raise self.missing(str(error)) from error
        self._done[number] = function
        for cell, held in zip(function.__closure__ or (), node["items"], strict=True):
            before = cell.cell_contents
            after = self.value(held, before)
            if after is not before:
                cell.cell_contents = after
        return function

    def _method(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        owner = self.value(node["items"][0], getattr(existing, "__self__", MISSING))
        try:
            return fill_method(node["name"], owner, existing)
        except LookupError as error:
            raise self.missing(str(error)) from error

    def _objects(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        shape = tuple(node["shape"])
        is_same = isinstance(existing, np.ndarray) and existing.dtype == object
        result = existing if is_same and existing.shape == shape else np.empty(shape, object)
        self._done[number] = result
        flat = result.reshape(-1)
        for i, value in enumerate(self.values(node["items"], list(flat))):
            flat[i] = value
        if result.size and flat.base is not result:
            result[...] = flat.reshape(shape)
        return result


_Filler = Callable[[_Restorer, int, dict[str, Any], Any], Any]

_FILLERS: dict[str, _Filler] = {
    "constant": _Restorer._constant,
    "object": _Restorer._object,
    "dict": _Restorer._dict,
    "list": _Restorer._list,
    "elsewhere": _Restorer._elsewhere,
    "numbers": _Restorer._numbers,
    "tuple": _Restorer._tuple,
    "set": _Restorer._set,
    "frozenset": _Restorer._set,
    "deque": _Restorer._deque,
    "bytes": _Restorer._bytes,
    "bytearray": _Restorer._bytes,
    "array.array": _Restorer._plain_array,
    "ndarray": _Restorer._ndarray,
    "objects": _Restorer._objects,
    "number": _Restorer._number,
    "partial": _Restorer._partial,
    "complex": _Restorer._complex,
    "range": _Restorer._range,
    "plain": _Restorer._plain,
    "enum": _Restorer._enum,
    "tensor": _Restorer._tensor,
    "optimizer": _Restorer._optimizer,
    "torch generator": _Restorer._torch_generator,
    "view": _Restorer._view,
    "function": _Restorer._function,
    "method": _Restorer._method,
    "generator": _Restorer._generator,
    "bit generator": _Restorer._bit_generator,
    "RandomState": _Restorer._random_state,
    "Random": _Restorer._random,
}
