"""From objects to data: every object once, with what it refers to by number."""

from __future__ import annotations

import array
import contextlib
import enum
import functools
import math
import random
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from snapshots.functions import METHODS, code_of, is_callable_of_ours, name_in_class
from snapshots.kinds import (
    NotRecordableError,
    find,
    has_cached,
    hides_state,
    is_constant,
    is_transient,
    keeps_order,
    left_out,
    likeness,
    name_of,
    slots,
)
from snapshots.leaves import LeafRecorder
from snapshots.plain_values import PLAIN_TYPES
from snapshots.shared_memory import axes_in_memory, bases, place_in

# Stands for an object that has a number: `["@", 3]`. Plain scalars stand for themselves.
REFERENCE = "@"
NUMBER = "#"  # a float that JSON has no word for: `["#", "nan"]`

_SCALARS = (type(None), bool, int, str)

LONG_LIST = 1000
# Whose subclasses may have attributes, or methods of their own.
DERIVED = (list, dict, set, frozenset, deque, tuple, np.ndarray, random.Random)


@dataclass
class Snapshot:
    """The state of some objects.

    Attributes:
        roots: what was recorded, by name, as cells: scalars, or references to nodes.
        nodes: the objects, each a dictionary with its ``kind`` and what that needs, as JSON.
        arrays: what nodes call by number.
        lost: what was left out that may make a difference, each named with its place.
    """

    roots: dict[str, Any] = field(default_factory=dict)
    nodes: list[dict[str, Any]] = field(default_factory=list)
    arrays: list[NDArray[Any]] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


def record(
    roots: dict[str, Any], constants: tuple[type, ...] = (), elsewhere: Iterable[list[Any]] = ()
) -> Snapshot:
    """Write down what objects hold, without changing them.

    Arrays of the snapshot may share memory with the objects: write it out before they go on.

    Args:
        roots: the objects, by name.
        constants: types whose objects stay as they are in what is built anew.
        elsewhere: lists whose content the caller keeps, and fills in again afterwards.

    Raises:
        NotRecordableError: if one holds what cannot be written down, naming its place.
    """
    recorder = _Recorder(constants, elsewhere)
    try:
        for name, value in roots.items():
            with recorder.at(name):
                recorder.snapshot.roots[name] = recorder.cell(value)
        recorder.tell_views()
    except RecursionError:
        raise NotRecordableError(recorder.place, "objects lie too deep inside each other") from None
    except (NotRecordableError, MemoryError):
        raise
    except Exception as error:  # objects may raise anything where they are looked into
        raise NotRecordableError(recorder.place, f"{type(error).__name__}: {error}") from error
    return recorder.snapshot


class _Recorder(LeafRecorder):
    def __init__(self, constants: tuple[type, ...], elsewhere: Iterable[list[Any]]) -> None:
        self.snapshot = Snapshot()
        self._constants = constants
        self._elsewhere = {id(value) for value in elsewhere}
        self._numbers: dict[int, int] = {}
        # An object that goes would leave its id to another.
        self._alive: list[Any] = []
        self._path: list[str] = []
        self._views: dict[int, NDArray[Any]] = {}

    @property
    def place(self) -> str:
        return "".join(self._path)

    @contextmanager
    def at(self, step: str) -> Iterator[None]:
        self._path.append(step)
        yield
        self._path.pop()

    def cell(self, value: Any) -> Any:
        """What stands for a value: itself, or a reference."""
        kind = type(value)
        if kind in _SCALARS:
            return value
        if kind is float:
            return value if math.isfinite(value) else [NUMBER, repr(value)]
        number = self._numbers.get(id(value))
        if number is None:
            number = len(self.snapshot.nodes)
            self._numbers[id(value)] = number
            self._alive.append(value)
            self.snapshot.nodes.append({})
            self.snapshot.nodes[number] = self._node(value)
        return [REFERENCE, number]

    def _node(self, value: Any) -> dict[str, Any]:
        if id(value) in self._elsewhere:
            return {"kind": "elsewhere"}
        for types, describe in _DESCRIPTIONS:
            if isinstance(value, types):
                described: dict[str, Any] = describe(self, value)
                return described | self._added(value)
        if is_callable_of_ours(value):
            return self._function(value)
        if is_constant(value, self._constants):
            name = name_of(value)
            is_there = name and find(name) is value
            if has_cached(value):
                self.snapshot.lost.append(f"the cache of {self.place}")
            return {"kind": "constant", "class": is_there and name, "like": likeness(value)}
        return self._object(value)

    def keep(self, values: NDArray[Any]) -> int:
        """The number of an array that the snapshot is to keep."""
        self.snapshot.arrays.append(values)
        return len(self.snapshot.arrays) - 1

    def cells(self, values: Iterable[Any]) -> list[Any]:
        """What stands for each of some values."""
        cells = []
        for i, value in enumerate(values):
            with self.at(f"[{i}]"):
                cells.append(self.cell(value))
        return cells

    def _named(self, values: Iterable[tuple[str, Any]]) -> list[list[Any]]:
        cells = []
        for name, value in values:
            with self.at(f".{name}"):
                cells.append([name, self.cell(value)])
        return cells

    def _object(self, value: Any) -> dict[str, Any]:
        kind = type(value)
        if hides_state(kind):
            name = f"{kind.__module__}.{kind.__qualname__}"
            raise NotRecordableError(self.place, f"what a {name} holds cannot be copied")
        names = [name for name in slots(kind) if hasattr(value, name)]
        attributes = {name: getattr(value, name) for name in names}
        attributes.update(getattr(value, "__dict__", {}))
        skipped = left_out(kind)
        kept = [
            (name, held)
            for name, held in attributes.items()
            if name not in skipped and not is_transient(held)
        ]
        return {"kind": "object", "class": name_of(kind), "attributes": self._named(kept)}

    def _added(self, value: Any) -> dict[str, Any]:
        """What a class that is derived from a plain one adds to it: its name and attributes."""
        kind = type(value)
        if kind.__module__ in ("builtins", "collections") or not isinstance(value, DERIVED):
            return {}
        names = [name for name in slots(kind) if hasattr(value, name)]
        attributes = {name: getattr(value, name) for name in names}
        attributes.update(getattr(value, "__dict__", {}))
        is_plain = isinstance(value, np.memmap) or not isinstance(value, list | dict | set | deque)
        if is_plain and (not attributes or isinstance(value, np.memmap)):
            return {}
        return {"class": name_of(kind), "attributes": self._named(attributes.items())}

    def _function(self, value: Any) -> dict[str, Any]:
        """A function with what it has closed over, or a method with its object."""
        if isinstance(value, METHODS):
            with self.at(".__self__"):
                held = [self.cell(value.__self__)]
            return {"kind": "method", "name": name_in_class(value), "items": held}
        with self.at("()"):
            cells = [cell.cell_contents for cell in value.__closure__ or ()]
            held = self.cells(cells)
        return {"kind": "function", "class": name_of(value), "code": code_of(value), "items": held}

    def tell_views(self) -> None:
        """Say of the arrays that lie in the memory of another where they do."""
        for number, value in list(self._views.items()):
            for base in bases(value):
                found = self._numbers.get(id(base))
                if found is not None and found != number:
                    node = self.snapshot.nodes[number]
                    # For its type alone: the base holds the rest.
                    self.snapshot.arrays[node["array"]] = np.empty(0, value.dtype)
                    node |= {"kind": "view", "base": [REFERENCE, found], **place_in(base, value)}
                    break

    def _dict(self, value: dict[Any, Any]) -> dict[str, Any]:
        items = []
        for key, held in value.items():
            with self.at(f"[{key!r}]" if isinstance(key, str | int) else "[...]"):
                items.append([self.cell(key), self.cell(held)])
        node = {"kind": "dict", "class": name_of(type(value)), "items": items}
        if isinstance(value, defaultdict):
            node["factory"] = self.cell(value.default_factory)
        return node

    def _list(self, value: list[Any]) -> dict[str, Any]:
        if type(value) is list and len(value) >= LONG_LIST:
            # Years of rewards, say: as text they would take as long as all else together.
            kinds = set(map(type, value))
            if kinds in ({float}, {int}):
                with contextlib.suppress(OverflowError):  # of whole numbers beyond 64 bits
                    array = np.array(value, float if kinds == {float} else np.int64)
                    return {"kind": "numbers", "array": self.keep(array)}
        return {"kind": "list", "items": self.cells(value)}

    def _tuple(self, value: tuple[Any, ...]) -> dict[str, Any]:
        return {"kind": "tuple", "class": name_of(type(value)), "items": self.cells(value)}

    def _set(self, value: set[Any] | frozenset[Any]) -> dict[str, Any]:
        kind = "set" if isinstance(value, set) else "frozenset"
        if not keeps_order(value):
            self.snapshot.lost.append(f"the order of {self.place}")
        return {"kind": kind, "items": self.cells(value)}

    def _deque(self, value: deque[Any]) -> dict[str, Any]:
        return {"kind": "deque", "longest": value.maxlen, "items": self.cells(value)}

    def _ndarray(self, value: NDArray[Any]) -> dict[str, Any]:
        if value.dtype == object:
            return {"kind": "objects", "shape": value.shape, "items": self.cells(value.flat)}
        if value.dtype.hasobject:
            raise NotRecordableError(self.place, "records of objects cannot be copied")
        if type(value) is np.ndarray and isinstance(value.base, np.ndarray):
            self._views[self._numbers[id(value)]] = value
        is_owner = not isinstance(value.base, np.ndarray)
        axes = axes_in_memory(value.strides)
        array = self.keep(np.asarray(value).transpose(axes))
        return {
            "kind": "ndarray",
            "array": array,
            "axes": axes,
            "is_owner": is_owner,
            "writeable": value.flags.writeable,
        }


# The first that fits counts.
_DESCRIPTIONS: tuple[tuple[Any, Any], ...] = (
    (enum.Enum, _Recorder._enum),
    (np.ndarray, _Recorder._ndarray),
    (np.generic, _Recorder._number),
    (th.Tensor, _Recorder._tensor),
    (th.optim.Optimizer, _Recorder._optimizer),
    (th.Generator, _Recorder._torch_generator),
    (np.random.Generator, _Recorder._generator),
    (np.random.BitGenerator, _Recorder._bit_generator),
    (np.random.RandomState, _Recorder._random_state),
    (random.Random, _Recorder._random),
    (dict, _Recorder._dict),
    (list, _Recorder._list),
    (th.Size, _Recorder._plain),
    (tuple, _Recorder._tuple),
    ((set, frozenset), _Recorder._set),
    (deque, _Recorder._deque),
    ((bytes, bytearray), _Recorder._bytes),
    (array.array, _Recorder._plain_array),
    (functools.partial, _Recorder._partial),
    (complex, _Recorder._complex),
    (range, _Recorder._range),
    (PLAIN_TYPES, _Recorder._plain),
)
