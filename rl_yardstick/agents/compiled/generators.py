"""Lets compiled functions draw from NumPy's random generators.

Passing a `numpy.random.Generator` to a compiled function takes longer than a training step, and an
array cannot hold generators. A handle is a record of the four addresses that drawing needs: the
generator's state and three functions. Drawing by a handle gives the generator's own next number.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import inlined, internal

if TYPE_CHECKING:
    from numpy.random import Generator

_ADDRESSES = ("state", "next_uint64", "next_uint32", "next_double")

HANDLE = np.dtype([(name, np.uintp) for name in _ADDRESSES], align=True)


def handles_of(generators: Sequence[Generator]) -> NDArray[np.void]:
    """A handle for each generator, shape (n,); valid while the generators exist."""
    handles = np.zeros(len(generators), dtype=HANDLE)
    for handle, generator in zip(handles, generators, strict=True):
        bits: Any = generator.bit_generator.ctypes
        handle["state"] = bits.state_address
        for name in _ADDRESSES[1:]:
            handle[name] = ctypes.cast(getattr(bits, name), ctypes.c_void_p).value or 0
    return handles


@intrinsic
def _generator(
    typing_context: Any, state: Any, next_uint64: Any, next_uint32: Any, next_double: Any
) -> Any:
    """Numba's representation of a generator, built from the four addresses."""

    def build(context: Any, builder: Any, signature: Any, addresses: Any) -> Any:
        struct: Any = cgutils.create_struct_proxy
        generator = struct(types.npy_rng)(context, builder)
        inside = context.data_model_manager[types.npy_rng].get_member_fe_type("bit_generator")
        bits = struct(inside)(context, builder)
        bits.state, *functions = addresses
        bits.fnptr_next_uint64, bits.fnptr_next_uint32, bits.fnptr_next_double = functions
        generator.bit_generator = bits._getvalue()
        return generator._getvalue()

    return types.npy_rng(*[types.uintp] * len(_ADDRESSES)), build


# Numba removes the first argument, which type checkers cannot know.
_generator_of_addresses: Any = _generator


@internal
def generator_of(handle: Any) -> Generator:
    """The generator of a handle, for use in compiled code."""
    generator: Generator = _generator_of_addresses(
        handle.state, handle.next_uint64, handle.next_uint32, handle.next_double
    )
    return generator


@inlined
def next_uniform(handle: Any) -> float:
    """Draw a number in [0, 1) from the handle's generator, like `Generator.random`."""
    return float(generator_of(handle).random())
