"""Makers of NumPy's arrays, types and numbers in pickles, and of the bytes in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.pickles import Build, Made, Maker

# Booleans, integers, floats, and objects; no texts, records or dates.
_TYPES = frozenset(["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "O8"])


def _dtype(made: Made, build: Build) -> np.dtype[Any]:
    code, state = made.args[0], made.state
    if code not in _TYPES:
        raise UnsafeFileError("holds an array of a type other than numbers")
    dtype = np.dtype(object if code == "O8" else code)
    return dtype.newbyteorder(state[1]) if isinstance(state, tuple) else dtype


def _array(data: Any, dtype: Any, shape: Any, order: Any = "C") -> NDArray[Any]:
    if isinstance(data, list) is not dtype.hasobject:
        raise TypeError("an array of objects has a list of them, others have bytes")
    flat = np.fromiter(data, object) if dtype.hasobject else np.frombuffer(data, dtype)
    return flat.reshape(shape, order=order).copy(order=order)  # an array on bytes is read-only


def _from_buffer(made: Made, build: Build) -> NDArray[Any]:
    data, dtype, shape, order, *axes = build(made.args)
    if axes:  # since NumPy 2.3, for an array with another memory order of its axes
        return _array(data, dtype, shape).transpose(axes[0])
    return _array(data, dtype, shape, order)


def _reconstructed(made: Made, build: Build) -> NDArray[Any]:
    _, shape, dtype, is_fortran, data = build(made.state)
    return _array(data, dtype, shape, "F" if is_fortran else "C")


def _scalar(made: Made, build: Build) -> Any:
    dtype, data = build(made.args)
    return _array(data, dtype, ())[()]


ARRAYS: Mapping[str, Maker] = {
    "numpy.dtype": _dtype,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy._core.multiarray._reconstruct": _reconstructed,
    "numpy._core.multiarray.scalar": _scalar,
    # How protocols 0 to 2 hold bytes.
    "builtins.bytes": lambda made, build: b"".join(made.args),  # of none
    "_codecs.encode": lambda made, build: build(made.args)[0].encode("latin1"),
}
