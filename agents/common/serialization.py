"""What a hand-written agent's zip holds beside its tables: plain JSON, never a pickle.

`encode` turns the attributes of an agent into JSON, `decode` turns them back. An object of another
kind is written as ``{"type": name, ...}`` and rebuilt from the fixed table here, so that reading a
file can build nothing else.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from agents.common.schedules import ExponentialSchedule

TYPE = "type"

# Of a space: no table is larger, and each has a row or a column for each of them.
_MAX_VALUES = 10_000_000

# Truth values and numbers of at most 64 bits, which JSON holds without loss.
_ARRAY_DTYPE = re.compile(r"[<>|][biuf][1248]")

# What most of an agent's attributes are made of.
_AS_THEY_ARE = frozenset({type(None), bool, int, float, str})


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
    if type(value) in _AS_THEY_ARE:
        return value
    if type(value) is dict:  # as its codec has it, for the hundred of them that Monitor has told of
        return {TYPE: "dict", "pairs": [_encode_all(pair) for pair in value.items()]}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return _encode_all(value)
    name = type(value).__name__
    codec = CODECS.get(name)
    if codec is None or type(value) is not codec.cls:
        raise UnknownTypeError(f"cannot be written as JSON: {type(value).__module__}.{name}")
    return {TYPE: name, **{key: encode(read(value)) for key, read in codec.fields.items()}}


def _encode_all(values: Iterable[Any]) -> list[Any]:
    return [value if type(value) in _AS_THEY_ARE else encode(value) for value in values]


def decode(data: Any) -> Any:
    """Rebuild what `encode` wrote.

    Raises:
        ValueError: if the data names a type that the format does not know, or if its fields are not
            those of that type.
    """
    if isinstance(data, list):
        return [decode(item) for item in data]
    if not isinstance(data, dict):
        return data
    name = data.get(TYPE)
    codec = CODECS.get(name) if isinstance(name, str) else None
    if codec is None:
        raise ValueError(f"unknown type {name!r} in an agent's file")
    if data.keys() != {TYPE, *codec.fields}:
        raise ValueError(f"damaged {name} in an agent's file: its fields are {', '.join(data)}")
    try:
        return codec.build(**{key: decode(item) for key, item in data.items() if key != TYPE})
    except (
        *(TypeError, LookupError, AttributeError, AssertionError, ArithmeticError),
        RecursionError,
    ) as error:
        raise ValueError(f"damaged {name} in an agent's file: {error}") from error


def _attributes(*names: str) -> dict[str, Callable[[Any], Any]]:
    return {name: attrgetter(name) for name in names}


def _space(cls: type, make: Callable[..., Any], **fields: Callable[[Any], Any]) -> Codec:
    """A space travels with its generator, so that it goes on sampling where it was."""

    def build(rng: np.random.Generator | None, **values: Any) -> Any:
        if not (rng is None or isinstance(rng, np.random.Generator)):
            raise TypeError(f"{rng!r} is no generator")
        space = make(**values)
        space._np_random = rng
        return space

    return Codec(cls, {**fields, "rng": attrgetter("_np_random")}, build)


def _pairs(mapping: Mapping[Any, Any]) -> list[list[Any]]:
    return [list(pair) for pair in mapping.items()]


def _dict(pairs: list[list[Any]]) -> dict[Any, Any]:
    return dict(pairs)


def _tuple(items: list[Any]) -> tuple[Any, ...]:
    return tuple(items)


def _generator_state(generator: np.random.Generator) -> Mapping[str, Any]:
    # The kind that `default_rng` makes, and the only one that `_generator` makes again.
    if not isinstance(generator.bit_generator, np.random.PCG64):
        raise UnknownTypeError(f"cannot be written as JSON: {generator}")
    return generator.bit_generator.state


def _generator(state: dict[str, Any]) -> np.random.Generator:
    generator = np.random.default_rng()
    generator.bit_generator.state = state
    return generator


def _array_dtype(array: np.ndarray[Any, Any]) -> str:
    dtype: str = array.dtype.str
    if not _ARRAY_DTYPE.fullmatch(dtype):
        raise UnknownTypeError(f"cannot be written as JSON: an array of {array.dtype}")
    return dtype


def _array(dtype: str, values: list[Any], shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    if not _ARRAY_DTYPE.fullmatch(dtype):
        raise ValueError(f"unknown array type {dtype!r} in an agent's file")
    return np.array(values, dtype=np.dtype(dtype)).reshape(shape)


def _discrete(n: int, start: int) -> spaces.Discrete:
    if n > _MAX_VALUES:
        raise ValueError(f"a space of more than {_MAX_VALUES:,} values in an agent's file")
    return spaces.Discrete(n, start=start)


def _multi_discrete(nvec: np.ndarray[Any, Any], start: np.ndarray[Any, Any]) -> Any:
    return spaces.MultiDiscrete(nvec, dtype=nvec.dtype.type, start=start)


def _box(low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> spaces.Box:
    return spaces.Box(low, high, dtype=low.dtype.type)


def _dict_space(pairs: list[list[Any]]) -> spaces.Dict:
    return spaces.Dict([(key, space) for key, space in pairs])


_CODEC_LIST = [
    Codec(dict, {"pairs": _pairs}, _dict),
    Codec(tuple, {"items": list}, _tuple),
    Codec(
        deque,
        {"iterable": list, "maxlen": attrgetter("maxlen")},
        deque,
    ),
    Codec(
        np.ndarray,
        {
            "dtype": _array_dtype,
            "shape": attrgetter("shape"),
            "values": lambda array: array.ravel().tolist(),
        },
        _array,
    ),
    Codec(np.random.Generator, {"state": _generator_state}, _generator),
    Codec(ConstantSchedule, _attributes("val"), ConstantSchedule),
    Codec(LinearSchedule, _attributes("start", "end", "end_fraction"), LinearSchedule),
    Codec(ExponentialSchedule, _attributes("start", "end", "end_fraction"), ExponentialSchedule),
    Codec(FloatSchedule, _attributes("value_schedule"), FloatSchedule),
    _space(spaces.Discrete, _discrete, **_attributes("n", "start")),
    _space(spaces.MultiDiscrete, _multi_discrete, **_attributes("nvec", "start")),
    _space(spaces.MultiBinary, spaces.MultiBinary, **_attributes("n")),
    _space(spaces.Box, _box, **_attributes("low", "high")),
    _space(spaces.Tuple, spaces.Tuple, spaces=lambda space: list(space.spaces)),
    # Pairs, since a Dict space puts the keys of a plain mapping into an order of its own.
    _space(spaces.Dict, _dict_space, pairs=lambda space: _pairs(space.spaces)),
]
CODECS = {codec.cls.__name__: codec for codec in _CODEC_LIST}
