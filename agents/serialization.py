"""What a hand-written agent's zip holds beside its tables: plain JSON, never a pickle.

`encode` turns the attributes of an agent into JSON, `decode` turns them back. An object of another
kind is written as ``{"type": name, ...}`` and rebuilt from the fixed table here, so that reading a
file can build nothing else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from agents.schedules import ExponentialSchedule

TYPE = "type"


class UnknownTypeError(TypeError):
    """An object that the file format has no place for."""


@dataclass(frozen=True)
class Codec:
    """How objects of one class are taken apart and built again.

    Attributes:
        cls: the class.
        fields: for each field of the file, how it is read off an object.
        build: makes the object from its fields.
    """

    cls: type
    fields: Mapping[str, Callable[[Any], Any]]
    build: Callable[..., Any]


def encode(value: Any) -> Any:
    """Turn ``value`` into JSON.

    Raises:
        UnknownTypeError: if it, or a part of it, is not of a type that the format knows.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list):
        return [encode(item) for item in value]
    name = type(value).__name__
    codec = CODECS.get(name)
    if codec is None or type(value) is not codec.cls:
        raise UnknownTypeError(f"cannot be written as JSON: {type(value).__module__}.{name}")
    return {TYPE: name, **{key: encode(read(value)) for key, read in codec.fields.items()}}


def decode(data: Any) -> Any:
    """Rebuild what `encode` wrote.

    Raises:
        ValueError: if the data names a type that the format does not know, or misses a field.
    """
    if isinstance(data, list):
        return [decode(item) for item in data]
    if not isinstance(data, dict):
        return data
    name = data.get(TYPE)
    codec = CODECS.get(name) if isinstance(name, str) else None
    if codec is None:
        raise ValueError(f"unknown type {name!r} in an agent's file")
    try:
        return codec.build(**{key: decode(item) for key, item in data.items() if key != TYPE})
    except (TypeError, KeyError, AttributeError, AssertionError) as error:
        raise ValueError(f"damaged {name} in an agent's file: {error}") from error


def _attributes(*names: str) -> dict[str, Callable[[Any], Any]]:
    return {name: attrgetter(name) for name in names}


def _space(cls: type, make: Callable[..., Any], **fields: Callable[[Any], Any]) -> Codec:
    """A space travels with its generator, so that it goes on sampling where it was."""

    def build(rng: np.random.Generator | None, **values: Any) -> Any:
        space = make(**values)
        space._np_random = rng
        return space

    return Codec(cls, {**fields, "rng": attrgetter("_np_random")}, build)


def _dict(pairs: list[list[Any]]) -> dict[Any, Any]:
    return dict(pairs)


def _tuple(items: list[Any]) -> tuple[Any, ...]:
    return tuple(items)


def _generator(state: dict[str, Any]) -> np.random.Generator:
    generator = np.random.default_rng()
    generator.bit_generator.state = state
    return generator


def _array(dtype: str, values: list[Any], shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    return np.array(values, dtype=np.dtype(dtype)).reshape(shape)


def _multi_discrete(nvec: np.ndarray[Any, Any], start: np.ndarray[Any, Any]) -> Any:
    return spaces.MultiDiscrete(nvec, dtype=nvec.dtype.type, start=start)


def _box(low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> spaces.Box:
    return spaces.Box(low, high, dtype=low.dtype.type)


_CODEC_LIST = [
    Codec(
        dict,
        {"pairs": lambda value: [list(pair) for pair in value.items()]},
        _dict,
    ),
    Codec(tuple, {"items": list}, _tuple),
    Codec(
        deque,
        {"iterable": list, "maxlen": attrgetter("maxlen")},
        deque,
    ),
    Codec(
        np.ndarray,
        {
            "dtype": attrgetter("dtype.str"),
            "shape": attrgetter("shape"),
            "values": lambda array: array.ravel().tolist(),
        },
        _array,
    ),
    Codec(np.random.Generator, {"state": attrgetter("bit_generator.state")}, _generator),
    Codec(ConstantSchedule, _attributes("val"), ConstantSchedule),
    Codec(LinearSchedule, _attributes("start", "end", "end_fraction"), LinearSchedule),
    Codec(ExponentialSchedule, _attributes("start", "end", "end_fraction"), ExponentialSchedule),
    Codec(FloatSchedule, _attributes("value_schedule"), FloatSchedule),
    _space(spaces.Discrete, spaces.Discrete, **_attributes("n", "start")),
    _space(spaces.MultiDiscrete, _multi_discrete, **_attributes("nvec", "start")),
    _space(spaces.MultiBinary, spaces.MultiBinary, **_attributes("n")),
    _space(spaces.Box, _box, **_attributes("low", "high")),
    _space(spaces.Tuple, spaces.Tuple, spaces=lambda space: list(space.spaces)),
    _space(spaces.Dict, spaces.Dict, spaces=lambda space: dict(space.spaces)),
]
CODECS = {codec.cls.__name__: codec for codec in _CODEC_LIST}
