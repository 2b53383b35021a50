"""From objects to data: every object once, with what it refers to by number."""

from __future__ import annotations

import array
import enum
import functools
import math
import random
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import BuiltinFunctionType, FunctionType
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from snapshots.kinds import (
    NotRecordableError,
    hides_state,
    is_constant,
    is_transient,
    left_out,
    name_of,
    slots,
)

# Stands for an object that has a number: `["@", 3]`. Plain scalars stand for themselves.
REFERENCE = "@"
NUMBER = "#"  # a float that JSON has no word for: `["#", "nan"]`

_SCALARS = (type(None), bool, int, str)

LONG_LIST = 1000
_LARGEST = 2**62  # of the numbers of long lists, which have to fit 64 bits


@dataclass
class Snapshot:
    """The state of some objects.

    Attributes:
        roots: what was recorded, by name, as cells: scalars, or references to nodes.
        nodes: the objects, each a dictionary with its ``kind`` and what that needs, as JSON.
        arrays: what nodes call by number.
    """

    roots: dict[str, Any] = field(default_factory=dict)
    nodes: list[dict[str, Any]] = field(default_factory=list)
    arrays: list[NDArray[Any]] = field(default_factory=list)


def record(roots: dict[str, Any], constants: tuple[type, ...] = ()) -> Snapshot:
    """Write down what objects hold, without changing them.

    Arrays of the snapshot may share memory with the objects: write it out before they go on.

    Args:
        roots: the objects, by name.
        constants: types whose objects stay as they are in what is built anew.

    Raises:
        NotRecordableError: if one holds what cannot be written down, naming its place.
    """
    recorder = _Recorder(constants)
    try:
        for name, value in roots.items():
            with recorder.at(name):
                recorder.snapshot.roots[name] = recorder.cell(value)
    except RecursionError:
        raise NotRecordableError(recorder.place, "objects lie too deep inside each other") from None
    return recorder.snapshot


class _Recorder:
    def __init__(self, constants: tuple[type, ...]) -> None:
        self.snapshot = Snapshot()
        self._constants = constants
        self._numbers: dict[int, int] = {}
        # An object that goes would leave its id to another.
        self._alive: list[Any] = []
        self._path: list[str] = []

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
        for types, describe in _DESCRIPTIONS:
            if isinstance(value, types):
                described: dict[str, Any] = describe(self, value)
                return described
        if is_constant(value, self._constants):
            is_found_by_name = isinstance(value, type | FunctionType | BuiltinFunctionType)
            return {"kind": "constant", "class": name_of(value) if is_found_by_name else ""}
        return self._object(value)

    def _array(self, values: NDArray[Any]) -> int:
        self.snapshot.arrays.append(values)
        return len(self.snapshot.arrays) - 1

    def _cells(self, values: Iterable[Any]) -> list[Any]:
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

    def _dict(self, value: dict[Any, Any]) -> dict[str, Any]:
        items = []
        for key, held in value.items():
            with self.at(f"[{key!r}]" if isinstance(key, str | int) else "[...]"):
                items.append([self.cell(key), self.cell(held)])
        return {"kind": "dict", "class": name_of(type(value)), "items": items}

    def _list(self, value: list[Any]) -> dict[str, Any]:
        if len(value) >= LONG_LIST:
            # Years of rewards, say: as text they would take as long as all else together.
            for kind in (float, int):
                if all(type(item) is kind and abs(item) < _LARGEST for item in value):
                    return {"kind": "numbers", "array": self._array(np.array(value, kind))}
        return {"kind": "list", "items": self._cells(value)}

    def _tuple(self, value: tuple[Any, ...]) -> dict[str, Any]:
        return {"kind": "tuple", "class": name_of(type(value)), "items": self._cells(value)}

    def _set(self, value: set[Any] | frozenset[Any]) -> dict[str, Any]:
        return {"kind": type(value).__name__, "items": self._cells(value)}

    def _deque(self, value: deque[Any]) -> dict[str, Any]:
        return {"kind": "deque", "longest": value.maxlen, "items": self._cells(value)}

    def _bytes(self, value: bytes | bytearray) -> dict[str, Any]:
        return {"kind": type(value).__name__, "array": self._array(_as_array(value))}

    def _plain_array(self, value: array.array[Any]) -> dict[str, Any]:
        held = _as_array(value.tobytes())
        return {"kind": "array.array", "type": value.typecode, "array": self._array(held)}

    def _ndarray(self, value: NDArray[Any]) -> dict[str, Any]:
        if value.dtype == object:
            return {"kind": "objects", "shape": value.shape, "items": self._cells(value.flat)}
        if value.dtype.hasobject:
            raise NotRecordableError(self.place, "records of objects cannot be copied")
        return {"kind": "ndarray", "array": self._array(value)}

    def _number(self, value: np.generic) -> dict[str, Any]:
        return {"kind": "number", "array": self._array(np.asarray(value))}

    def _complex(self, value: complex) -> dict[str, Any]:
        return {"kind": "complex", "items": self._cells([value.real, value.imag])}

    def _range(self, value: range) -> dict[str, Any]:
        return {"kind": "range", "items": [value.start, value.stop, value.step]}

    def _partial(self, value: functools.partial[Any]) -> dict[str, Any]:
        return {"kind": "partial", "items": self._cells([value.func, value.args, value.keywords])}

    def _enum(self, value: enum.Enum) -> dict[str, Any]:
        return {"kind": "enum", "class": name_of(type(value)), "name": value.name}

    def _tensor(self, value: th.Tensor) -> dict[str, Any]:
        if value.is_sparse or value.is_quantized:
            raise NotRecordableError(self.place, "only dense tensors can be copied")
        plain = value.detach().cpu().contiguous()
        # NumPy has no bfloat16 and its like: their bytes are kept.
        held = plain.reshape(-1).view(th.uint8).numpy() if plain.numel() else np.zeros(0, np.uint8)
        return {
            "kind": "tensor",
            "type": str(plain.dtype).removeprefix("torch."),
            "shape": list(plain.shape),
            "array": self._array(held),
            "is_trained": bool(value.requires_grad and value.is_leaf),
        }

    def _optimizer(self, value: th.optim.Optimizer) -> dict[str, Any]:
        return {"kind": "optimizer", "state": self.cell(value.state_dict())}

    def _torch_generator(self, value: th.Generator) -> dict[str, Any]:
        return {"kind": "torch generator", "array": self._array(value.get_state().numpy())}

    def _generator(self, value: np.random.Generator) -> dict[str, Any]:
        source = value.bit_generator
        seeds = source.seed_seq
        return {
            "kind": "generator",
            "class": type(source).__name__,
            "state": self.cell(source.state),
            "seeds": self.cell(seeds.state if isinstance(seeds, np.random.SeedSequence) else None),
        }

    def _random_state(self, value: np.random.RandomState) -> dict[str, Any]:
        return {"kind": "RandomState", "state": self.cell(value.get_state(legacy=False))}

    def _random(self, value: random.Random) -> dict[str, Any]:
        return {"kind": "Random", "state": self.cell(value.getstate())}


def _as_array(content: bytes | bytearray) -> NDArray[np.uint8]:
    return np.frombuffer(content, np.uint8) if content else np.zeros(0, np.uint8)


# The first that fits counts.
_DESCRIPTIONS: tuple[tuple[Any, Any], ...] = (
    (enum.Enum, _Recorder._enum),
    (np.ndarray, _Recorder._ndarray),
    (np.generic, _Recorder._number),
    (th.Tensor, _Recorder._tensor),
    (th.optim.Optimizer, _Recorder._optimizer),
    (th.Generator, _Recorder._torch_generator),
    (np.random.Generator, _Recorder._generator),
    (np.random.RandomState, _Recorder._random_state),
    (random.Random, _Recorder._random),
    (dict, _Recorder._dict),
    (list, _Recorder._list),
    (tuple, _Recorder._tuple),
    ((set, frozenset), _Recorder._set),
    (deque, _Recorder._deque),
    ((bytes, bytearray), _Recorder._bytes),
    (array.array, _Recorder._plain_array),
    (functools.partial, _Recorder._partial),
    (complex, _Recorder._complex),
    (range, _Recorder._range),
)
