"""What a snapshot says of values that hold no objects of the user's."""

from __future__ import annotations

import array
import enum
import functools
import random
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from snapshots.kinds import NotRecordableError, name_of
from snapshots.plain_values import plain_words
from snapshots.shared_memory import axes_in_memory


class LeafRecorder(ABC):
    """Describes numbers, texts, tensors and generators; `snapshots.recording` has the rest."""

    @property
    @abstractmethod
    def place(self) -> str:
        """Where the value that is being recorded lies."""

    @abstractmethod
    def cell(self, value: Any) -> Any:
        """What stands for a value."""

    @abstractmethod
    def cells(self, values: Iterable[Any]) -> list[Any]:
        """What stands for each of some values."""

    @abstractmethod
    def keep(self, values: NDArray[Any]) -> int:
        """The number of an array that the snapshot is to keep."""

    def _bytes(self, value: bytes | bytearray) -> dict[str, Any]:
        return {"kind": type(value).__name__, "array": self.keep(_as_array(value))}

    def _plain_array(self, value: array.array[Any]) -> dict[str, Any]:
        held = _as_array(value.tobytes())
        return {"kind": "array.array", "type": value.typecode, "array": self.keep(held)}

    def _number(self, value: np.generic) -> dict[str, Any]:
        return {"kind": "number", "array": self.keep(np.asarray(value))}

    def _complex(self, value: complex) -> dict[str, Any]:
        return {"kind": "complex", "items": self.cells([value.real, value.imag])}

    def _range(self, value: range) -> dict[str, Any]:
        return {"kind": "range", "items": [value.start, value.stop, value.step]}

    def _partial(self, value: functools.partial[Any]) -> dict[str, Any]:
        return {"kind": "partial", "items": self.cells([value.func, value.args, value.keywords])}

    def _plain(self, value: Any) -> dict[str, Any]:
        words = plain_words(value)
        if words is None:
            kind = name_of(type(value)).replace(":", ".")
            raise NotRecordableError(self.place, f"what a {kind} holds cannot be copied")
        return {"kind": "plain", "name": words[0], "items": self.cells(words[1])}

    def _enum(self, value: enum.Enum) -> dict[str, Any]:
        return {"kind": "enum", "class": name_of(type(value)), "value": self.cell(value.value)}

    def _tensor(self, value: th.Tensor) -> dict[str, Any]:
        if value.is_sparse or value.is_quantized:
            raise NotRecordableError(self.place, "only dense tensors can be copied")
        plain = value.detach().resolve_conj().resolve_neg().cpu()
        axes = axes_in_memory(plain.stride())
        plain = plain.permute(axes).contiguous()
        # NumPy has no bfloat16 and its like: their bytes are kept.
        held = plain.reshape(-1).view(th.uint8).numpy() if plain.numel() else np.zeros(0, np.uint8)
        return {
            "kind": "tensor",
            "type": str(plain.dtype).removeprefix("torch."),
            "shape": list(plain.shape),
            "axes": axes,
            "array": self.keep(held),
            "is_parameter": isinstance(value, th.nn.Parameter),
            "is_trained": bool(value.requires_grad and value.is_leaf),
        }

    def _optimizer(self, value: th.optim.Optimizer) -> dict[str, Any]:
        return {"kind": "optimizer", "state": self.cell(value.state_dict())}

    def _torch_generator(self, value: th.Generator) -> dict[str, Any]:
        return {"kind": "torch generator", "array": self.keep(value.get_state().numpy())}

    def _generator(self, value: np.random.Generator) -> dict[str, Any]:
        return {"kind": "generator", "source": self.cell(value.bit_generator)}

    def _bit_generator(self, value: Any) -> dict[str, Any]:
        seeds = value.seed_seq
        return {
            "kind": "bit generator",
            "class": type(value).__name__,
            "state": self.cell(value.state),
            "seeds": self.cell(seeds.state if isinstance(seeds, np.random.SeedSequence) else None),
        }

    def _random_state(self, value: np.random.RandomState) -> dict[str, Any]:
        return {"kind": "RandomState", "state": self.cell(value.get_state(legacy=False))}

    def _random(self, value: random.Random) -> dict[str, Any]:
        return {"kind": "Random", "state": self.cell(value.getstate())}


def _as_array(content: bytes | bytearray) -> NDArray[np.uint8]:
    return np.frombuffer(content, np.uint8) if content else np.zeros(0, np.uint8)
