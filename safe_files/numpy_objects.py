"""NumPy's objects in pickles: types, arrays, numbers and generators."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from safe_files.pickle_trees import Made
from safe_files.rebuilding import Build, Maker, arguments, wrong
from safe_files.refusals import UnsafeFileError

# Booleans, whole numbers, floats; no texts, records, dates, and no Python objects.
_TYPES = frozenset({"b1", *(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8))}) | {
    "f2",
    "f4",
    "f8",
}
_OBJECT = "O8"
_ORDERS = "<>=|"
_MAX_DIMENSIONS = 32
_MAX_POOL = 64


def _dtype(made: Made, build: Build) -> np.dtype[Any]:
    code = made.args[0] if made.args else None
    state = made.state
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "="
    if code == _OBJECT:
        return np.dtype(object)
    if code not in _TYPES or not isinstance(order, str) or order not in _ORDERS:
        raise UnsafeFileError("holds an array of a type other than numbers")
    return np.dtype(str(code)).newbyteorder(order)  # type: ignore[arg-type]


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    shape = (shape,) if isinstance(shape, int) else shape
    fits = (
        isinstance(dtype, np.dtype)
        and isinstance(shape, tuple)
        and len(shape) <= _MAX_DIMENSIONS
        and all(isinstance(n, int) and n >= 0 for n in shape)
        and order in {"C", "F"}
    )
    if not fits:
        raise UnsafeFileError("holds an array that is not as NumPy writes it")
    count = math.prod(shape)
    if dtype.hasobject:
        return _object_array(data, count, shape, order)
    if not isinstance(data, bytes) or len(data) != count * dtype.itemsize:
        raise UnsafeFileError("holds an array whose size does not match its data")
    # A copy, since what is read from bytes cannot be written to.
    return np.frombuffer(data, dtype).reshape(shape, order=order).copy(order=order)


def _object_array(data: Any, count: int, shape: tuple[int, ...], order: Any) -> NDArray[Any]:
    """An array of dictionaries and plain values, such as the infos of a replay buffer."""
    if not isinstance(data, list) or len(data) != count:
        raise UnsafeFileError("holds an array whose size does not match its data")
    flat = np.empty(count, dtype=object)
    for index, value in enumerate(data):
        flat[index] = value
    return flat.reshape(shape, order=order)


def _from_buffer(made: Made, build: Build) -> NDArray[Any]:
    data, dtype, shape, order = arguments(made, build, bytes, np.dtype, (tuple, int), str)
    return _array(data, dtype, shape, order)


def _reconstructed(made: Made, build: Build) -> NDArray[Any]:
    state = build(made.state)
    if not (isinstance(state, tuple) and len(state) == 5) or made.items or made.pairs:
        raise wrong(made)
    _, shape, dtype, is_fortran, data = state
    return _array(data, dtype, shape, "F" if is_fortran else "C")


def _scalar(made: Made, build: Build) -> Any:
    dtype, data = arguments(made, build, np.dtype, bytes)
    return _array(data, dtype, (), "C")[()]


def _seed_sequence(made: Made, build: Build) -> np.random.SeedSequence:
    """What a generator was seeded with; its class and a checksum are the arguments."""
    state = build(made.state)
    if not (isinstance(state, tuple) and len(state) == 5) or made.items or made.pairs:
        raise wrong(made)
    entropy, n_children, _, pool_size, spawn_key = state
    if not (isinstance(pool_size, int) and pool_size <= _MAX_POOL):
        raise wrong(made)
    return np.random.SeedSequence(
        entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_children
    )


def _bit_generator(made: Made, build: Build) -> np.random.PCG64:
    state = None if made.state is None else build(made.state)
    seeds = None
    if isinstance(state, tuple) and len(state) == 2:
        state, seeds = state
    if not (seeds is None or isinstance(seeds, np.random.SeedSequence)):
        raise wrong(made)
    generator = np.random.PCG64(seeds)
    if state is not None:
        generator.state = cast(Any, state)
    return generator


def _generator(made: Made, build: Build) -> np.random.Generator:
    # Older files name the maker of the inner generator as a second argument.
    inner = build(made.args[0]) if made.args else None
    if not isinstance(inner, np.random.PCG64):
        raise wrong(made)
    return np.random.Generator(inner)


MAKERS: Mapping[str, Maker] = {
    "numpy.dtype": _dtype,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy._core.multiarray._reconstruct": _reconstructed,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy.random.bit_generator.__pyx_unpickle_SeedSequence": _seed_sequence,
    "numpy.random._pickle.__bit_generator_ctor": _bit_generator,
    "numpy.random._pickle.__generator_ctor": _generator,
}

CLASSES: Mapping[str, type] = {
    f"numpy.{kind.__name__}": kind
    for kind in (np.ndarray, np.float32, np.float64, np.int64, np.int32, np.int8, np.uint8)
} | {
    "numpy.bool_": np.bool_,
    "numpy.bool": np.bool_,
    "numpy.random._pcg64.PCG64": np.random.PCG64,
    "numpy.random.bit_generator.SeedSequence": np.random.SeedSequence,
}
