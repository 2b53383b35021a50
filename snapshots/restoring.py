"""From data to objects: those that are there are filled in place, the rest is made anew."""

from __future__ import annotations

import array
import functools
import os
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from snapshots.filling import (
    NotRestorableError,
    fill_array,
    fill_generator,
    fill_random,
    fill_random_state,
    fill_tensor,
    fill_torch_generator,
)
from snapshots.kinds import find, hides_state, is_transient, left_out, name_of, slots
from snapshots.recording import REFERENCE, Snapshot

# Of a snapshot that fits, every value was there when it was taken.
_MISSING: Any = object()


def restore(
    snapshot: Snapshot, roots: dict[str, Any], moved: Mapping[str, str] | None = None
) -> None:
    """Fill objects with what was recorded of others of the same build.

    Args:
        snapshot: the record.
        roots: the objects to fill, by the names that they were recorded under.
        moved: folders that have another name by now; texts that begin with one are changed.

    Raises:
        NotRestorableError: if they are of another build; some are filled by then.
    """
    restorer = _Restorer(snapshot, moved or {})
    for name, existing in roots.items():
        if restorer.value(snapshot.roots[name], existing) is not existing:
            raise NotRestorableError(f"{name} is not what was recorded")


class _Restorer:
    def __init__(self, snapshot: Snapshot, moved: Mapping[str, str]) -> None:
        self._snapshot = snapshot
        self._moved = moved
        self._done: dict[int, Any] = {}
        self._path: list[str] = []
        # By id, which stays theirs as long as they are held here.
        self._claimed: dict[int, Any] = {}

    def value(self, cell: Any, existing: Any = _MISSING) -> Any:
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
            filled = _FILLERS[node["kind"]](self, content, node, _MISSING if is_taken else existing)
            self._done[content] = filled
        return self._done[content]

    def _text(self, text: str) -> str:
        for before, now in self._moved.items():
            if text == before or text.startswith(before + os.sep):
                return now + text[len(before) :]
        return text

    def _missing(self, what: str) -> NotRestorableError:
        return NotRestorableError(f"{what} is missing in {'.'.join(self._path) or 'it'}")

    def _values(self, cells: list[Any], existing: Any = ()) -> list[Any]:
        found = list(existing)
        known = found + [_MISSING] * (len(cells) - len(found))
        return [self.value(cell, old) for cell, old in zip(cells, known, strict=False)]

    def _held(self, node: dict[str, Any]) -> NDArray[Any]:
        array: NDArray[Any] = self._snapshot.arrays[node["array"]]
        return array

    def _class(self, node: dict[str, Any], existing: Any) -> Any:
        """The class that a node names: that of what is there, or one that is imported already."""
        if name_of(type(existing)) == node["class"]:
            return type(existing)
        found = find(node["class"])
        if not isinstance(found, type):
            raise self._missing(f"the class {node['class']}")
        return found

    def _constant(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        if node["class"] and name_of(existing) != node["class"]:
            found = find(node["class"])
            if found is not None:
                return found
        if existing is _MISSING:
            raise self._missing(node["class"] or "a part")
        return existing

    def _object(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self._class(node, existing)
        if type(existing) is not kind:
            if hides_state(kind):
                raise self._missing(node["class"])
            existing = object.__new__(kind)
        self._done[number] = existing
        skipped = left_out(kind)
        attributes = dict(node["attributes"])
        inside, in_slots = getattr(existing, "__dict__", {}), set(slots(kind))
        for name in set(inside) - attributes.keys() - skipped:
            if not is_transient(inside[name]):
                del inside[name]
        for name, cell in attributes.items():
            self._path.append(name)
            if name in in_slots:
                new = self.value(cell, getattr(existing, name, _MISSING))
                object.__setattr__(existing, name, new)
            else:
                inside[name] = self.value(cell, inside.get(name, _MISSING))
            self._path.pop()
        return existing

    def _dict(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self._class(node, existing)
        if type(existing) is not kind:
            if kind not in (dict, OrderedDict, defaultdict):
                raise self._missing(node["class"])
            existing = kind()
        self._done[number] = existing
        before = dict(existing)
        keys = [*before, *[_MISSING] * len(node["items"])]
        existing.clear()
        for (key_cell, cell), old_key in zip(node["items"], keys, strict=False):
            key = self.value(key_cell, old_key)
            existing[key] = self.value(cell, before.get(key, _MISSING))
        return existing

    def _list(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        result = existing if isinstance(existing, list) else []
        self._done[number] = result
        before = list(result)
        result[:] = self._values(node["items"], before)
        return result

    def _numbers(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        result = existing if isinstance(existing, list) else []
        result[:] = self._held(node).tolist()
        return result

    def _tuple(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self._class(node, existing)
        before = existing if isinstance(existing, tuple) else ()
        values = self._values(node["items"], before)
        is_same = type(existing) is kind and len(before) == len(values)
        if is_same and all(new is old for new, old in zip(values, before, strict=True)):
            return existing
        if hasattr(kind, "_fields"):
            return tuple.__new__(kind, values)
        return kind(values)

    def _set(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        values = self._values(node["items"])
        if node["kind"] == "frozenset":
            return frozenset(values)
        result = existing if isinstance(existing, set) else set()
        result.clear()
        result.update(values)
        return result

    def _deque(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        is_same = isinstance(existing, deque) and existing.maxlen == node["longest"]
        result = existing if is_same else deque(maxlen=node["longest"])
        self._done[number] = result
        before = list(result)
        result.clear()
        result.extend(self._values(node["items"], before))
        return result

    def _bytes(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        content = self._held(node).tobytes()
        return content if node["kind"] == "bytes" else bytearray(content)

    def _plain_array(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        result = existing if isinstance(existing, array.array) else array.array(node["type"])
        del result[:]
        result.frombytes(self._held(node).tobytes())
        return result

    def _ndarray(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_array(self._held(node), existing)

    def _objects(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        shape = tuple(node["shape"])
        is_same = isinstance(existing, np.ndarray) and existing.dtype == object
        result = existing if is_same and existing.shape == shape else np.empty(shape, object)
        self._done[number] = result
        flat = result.reshape(-1)
        for i, value in enumerate(self._values(node["items"], list(flat))):
            flat[i] = value
        if result.size and flat.base is not result:
            result[...] = flat.reshape(shape)
        return result

    def _number(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return self._held(node)[()]

    def _complex(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return complex(*self._values(node["items"]))

    def _range(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return range(*node["items"])

    def _partial(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        is_same = isinstance(existing, functools.partial)
        before = [existing.func, existing.args, existing.keywords] if is_same else []
        function, arguments, keywords = self._values(node["items"], before)
        return functools.partial(function, *arguments, **keywords)

    def _enum(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return self._class(node, existing)[node["name"]]

    def _tensor(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_tensor(
            self._held(node), node["type"], node["shape"], node["is_trained"], existing
        )

    def _optimizer(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        if not isinstance(existing, th.optim.Optimizer):
            raise self._missing("an optimizer")
        existing.load_state_dict(self.value(node["state"]))
        return existing

    def _torch_generator(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_torch_generator(self._held(node), existing)

    def _generator(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_generator(
            node["class"], self.value(node["seeds"]), self.value(node["state"]), existing
        )

    def _random_state(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_random_state(self.value(node["state"]), existing)

    def _random(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_random(self.value(node["state"]), existing)


_Filler = Callable[[_Restorer, int, dict[str, Any], Any], Any]

_FILLERS: dict[str, _Filler] = {
    "constant": _Restorer._constant,
    "object": _Restorer._object,
    "dict": _Restorer._dict,
    "list": _Restorer._list,
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
    "enum": _Restorer._enum,
    "tensor": _Restorer._tensor,
    "optimizer": _Restorer._optimizer,
    "torch generator": _Restorer._torch_generator,
    "generator": _Restorer._generator,
    "RandomState": _Restorer._random_state,
    "Random": _Restorer._random,
}
