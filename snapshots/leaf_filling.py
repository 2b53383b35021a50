"""Values that hold no objects of the user's, filled or made anew from a snapshot."""

from __future__ import annotations

import array
import enum
import functools
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from snapshots.filling import (
    NotRestorableError,
    fill_bit_generator,
    fill_random,
    fill_random_state,
    fill_tensor,
    fill_torch_generator,
    tensor_of,
)
from snapshots.plain_values import PLAIN_KINDS

# Of a snapshot that fits, every value was there when it was taken.
MISSING: Any = object()


class LeafFiller(ABC):
    """Fills numbers, texts, tensors and generators; `snapshots.restoring` has the rest."""

    @abstractmethod
    def value(self, cell: Any, existing: Any = MISSING) -> Any:
        """The value that a cell stands for."""

    @abstractmethod
    def values(self, cells: list[Any], existing: Any = ()) -> list[Any]:
        """The values that some cells stand for."""

    @abstractmethod
    def held(self, node: dict[str, Any]) -> NDArray[Any]:
        """The array of a node."""

    @abstractmethod
    def class_of(self, node: dict[str, Any], existing: Any) -> Any:
        """The class that a node names."""

    @abstractmethod
    def missing(self, what: str) -> NotRestorableError:
        """Says that something is not there."""

    def _bytes(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        content = self.held(node).tobytes()
        return content if node["kind"] == "bytes" else bytearray(content)

    def _plain_array(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        result = existing if isinstance(existing, array.array) else array.array(node["type"])
        del result[:]
        result.frombytes(self.held(node).tobytes())
        return result

    def _number(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return self.held(node)[()]

    def _complex(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return complex(*self.values(node["items"]))

    def _range(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return range(*node["items"])

    def _partial(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        is_same = isinstance(existing, functools.partial)
        before = [existing.func, existing.args, existing.keywords] if is_same else []
        function, arguments, keywords = self.values(node["items"], before)
        return functools.partial(function, *arguments, **keywords)

    def _plain(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = PLAIN_KINDS[node["name"]]
        words = self.values(node["items"])
        is_same = isinstance(existing, kind.types) and kind.words(existing) == words
        return existing if is_same else kind.make(*words)

    def _enum(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        kind = self.class_of(node, existing)
        if not issubclass(kind, enum.Enum):
            raise self.missing(node["class"])
        return kind(self.value(node["value"]))

    def _tensor(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        plain = tensor_of(self.held(node), node["type"], node["shape"], node["axes"])
        if node["is_parameter"] and not isinstance(existing, th.nn.Parameter):
            return th.nn.Parameter(plain, node["is_trained"])
        return fill_tensor(plain, node["is_trained"], existing)

    def _optimizer(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        if not isinstance(existing, th.optim.Optimizer):
            raise self.missing("an optimizer")
        existing.load_state_dict(self.value(node["state"]))
        return existing

    def _torch_generator(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_torch_generator(self.held(node), existing)

    def _generator(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        is_same = isinstance(existing, np.random.Generator)
        source = self.value(node["source"], existing.bit_generator if is_same else MISSING)
        if is_same and existing.bit_generator is source:
            return existing
        return np.random.Generator(source)

    def _bit_generator(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_bit_generator(
            node["class"], self.value(node["seeds"]), self.value(node["state"]), existing
        )

    def _random_state(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_random_state(self.value(node["state"]), existing)

    def _random(self, number: int, node: dict[str, Any], existing: Any) -> Any:
        return fill_random(self.value(node["state"]), existing)
