"""Arrays, tensors and generators, filled in place where they can be."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

_BIT_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


class NotRestorableError(Exception):
    """A snapshot does not fit what was built anew."""


def fill_array(held: NDArray[Any], existing: Any) -> NDArray[Any]:
    """An array of those values: the existing one, where it is alike and can be written to."""
    is_same = isinstance(existing, np.ndarray) and existing.dtype == held.dtype
    if not is_same or existing.shape != held.shape:
        return held.copy()
    if existing.flags.writeable:
        existing[...] = held
    elif existing.tobytes() != held.tobytes():
        return held.copy()
    # Others may hold it too.
    found: NDArray[Any] = existing
    return found


def fill_tensor(
    held: NDArray[np.uint8], dtype: str, shape: list[int], is_trained: bool, existing: Any
) -> th.Tensor:
    """A tensor of those bytes; ``is_trained`` says whether a new one takes gradients."""
    kind = getattr(th, dtype)
    plain = th.from_numpy(held.copy()).view(kind).reshape(shape)
    is_same = isinstance(existing, th.Tensor) and existing.dtype == kind
    if not is_same or list(existing.shape) != shape:
        return plain.requires_grad_(is_trained)
    found: th.Tensor = existing
    with th.no_grad():
        found.copy_(plain)
    return found


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
