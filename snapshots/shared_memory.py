"""Arrays that look into others' memory, so that they look into the same place again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def bases(view: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """The arrays in whose memory one lies, the nearest first."""
    base = view.base
    while type(base) is np.ndarray:
        if base.flags.forc and not base.dtype.hasobject:
            yield base
        base = base.base


def axes_in_memory(strides: Sequence[int]) -> list[int]:
    """The axes of an array from the one with the longest strides to that with the shortest.

    In that order its elements lie in memory, by which sums and products differ in their last bits.
    """
    return sorted(range(len(strides)), key=lambda axis: -abs(strides[axis]))


def place_in(base: NDArray[Any], view: NDArray[Any]) -> dict[str, Any]:
    """Where in the memory of a base a view lies, as JSON."""
    return {
        "offset": _address(view) - _address(base),
        "strides": view.strides,
        "shape": view.shape,
        "writeable": view.flags.writeable,
    }


def view_at(
    base: NDArray[Any], dtype: np.dtype[Any], place: dict[str, Any], existing: Any
) -> NDArray[Any]:
    """The view at that place of a base; the existing one, where it is that.

    Raises:
        ValueError: if the base does not reach so far.
    """
    offset, shape, strides = place["offset"], tuple(place["shape"]), tuple(place["strides"])
    if (
        type(existing) is np.ndarray
        and any(found is base for found in bases(existing))
        and (existing.dtype, existing.shape, existing.strides) == (dtype, shape, strides)
        and _address(existing) == _address(base) + offset
    ):
        return existing
    view: NDArray[Any] = np.ndarray(shape, dtype, base, offset, strides)
    view.flags.writeable = place["writeable"] and base.flags.writeable
    return view


def is_view(value: Any) -> bool:
    """Whether a value is an array that lies in another's memory."""
    return isinstance(value, np.ndarray) and isinstance(value.base, np.ndarray)


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])
