"""Arrays, tensors and generators, filled in place where they can be."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

_BIT_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")

_PIECE = 1 << 20  # bytes


class NotRestorableError(Exception):
    """A snapshot does not fit what was built anew."""


def fill_array(held: NDArray[Any], existing: Any) -> NDArray[Any]:
    """An array of those values: the existing one, where it is alike and can be written to."""
    is_same = isinstance(existing, np.ndarray) and existing.dtype == held.dtype
    if not is_same or existing.shape != held.shape or _lie_otherwise(held, existing):
        return held.copy(order="K")
    if existing.flags.writeable:
        _copy(held, existing)
    elif existing.tobytes() != held.tobytes():
        return held.copy(order="K")
    # Others may hold it too.
    found: NDArray[Any] = existing
    return found


def _copy(held: NDArray[Any], existing: NDArray[Any]) -> None:
    """Write values into an array, but for zeros where there are zeros.

    What a replay buffer has not used so far takes no memory, and is not to take any now.
    """
    if not (held.flags.c_contiguous and existing.flags.c_contiguous):
        existing[...] = held
        return
    new, old = (array.reshape(-1).view(np.uint8) for array in (held, existing))
    for begin in range(0, len(new), _PIECE):
        piece = slice(begin, begin + _PIECE)
        if new[piece].any() or old[piece].any():
            old[piece] = new[piece]


def tensor_of(held: NDArray[np.uint8], dtype: str, shape: list[int], axes: list[int]) -> th.Tensor:
    """A new tensor of those bytes, whose axes lie in memory in that order."""
    kind = getattr(th, dtype)
    flat = th.from_numpy(held.copy()).view(kind) if held.size else th.empty(0, dtype=kind)
    return flat.reshape(shape).permute([axes.index(axis) for axis in range(len(axes))])


def fill_tensor(plain: th.Tensor, is_trained: bool, existing: Any) -> th.Tensor:
    """The existing tensor with the values of a plain one, or where it is another, that one.

    Args:
        plain: the values.
        is_trained: whether it takes gradients.
        existing: what is there.
    """
    is_same = isinstance(existing, th.Tensor) and existing.dtype == plain.dtype
    if not is_same or existing.shape != plain.shape:
        return plain.requires_grad_(is_trained)
    found: th.Tensor = existing
    with th.no_grad():
        found.copy_(plain)
    if found.is_leaf and found.requires_grad != is_trained:
        found.requires_grad_(is_trained)
    return found


def _lie_otherwise(held: NDArray[Any], existing: NDArray[Any]) -> bool:
    """Whether one runs through its rows in memory, and the other through its columns."""
    rows = (held.flags.c_contiguous, existing.flags.c_contiguous)
    return held.flags.forc and existing.flags.forc and rows[0] != rows[1]


def fill_torch_generator(held: NDArray[np.uint8], existing: Any) -> th.Generator:
    """PyTorch's generator in that state."""
    result = existing if isinstance(existing, th.Generator) else th.Generator()
    result.set_state(th.from_numpy(held.copy()))
    return result


def fill_bit_generator(
    name: str, seeds: dict[str, Any] | None, state: Any, existing: Any
) -> np.random.BitGenerator:
    """A source of bits in that state; another one where it was seeded otherwise.

    Raises:
        NotRestorableError: if there is none of that name.
    """
    if type(existing).__name__ == name and seeds == _seeds_of(existing):
        result: np.random.BitGenerator = existing
    else:
        result = _new_bit_generator(name, seeds)
    result.state = state
    return result


def fill_random_state(state: Any, existing: Any) -> np.random.RandomState:
    """NumPy's older generator in that state."""
    is_same = isinstance(existing, np.random.RandomState)
    result = existing if is_same else np.random.RandomState()  # as recorded
    result.set_state(state)
    return result


def fill_random(state: Any, existing: Any) -> random.Random:
    """Python's generator in that state."""
    result = existing if isinstance(existing, random.Random) else random.Random()  # noqa: S311
    result.setstate(state)
    return result


def _seeds_of(source: np.random.BitGenerator) -> Any:
    seeds = source.seed_seq
    return seeds.state if isinstance(seeds, np.random.SeedSequence) else None


def _new_bit_generator(name: str, seeds: dict[str, Any] | None) -> np.random.BitGenerator:
    if name not in _BIT_GENERATORS:
        raise NotRestorableError(f"there is no bit generator {name}")
    make = getattr(np.random, name)
    found: np.random.BitGenerator = (
        make() if seeds is None else make(np.random.SeedSequence(**seeds))
    )
    return found
