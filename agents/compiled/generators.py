"""NumPy's random generators as compiled functions draw from them.

Handing a `numpy.random.Generator` to a compiled function takes longer than a step of training, and
an array cannot hold several. A handle is a record of the four addresses that drawing needs: of the
generator's state and of three functions. A draw by a handle is the generator's own next number.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from machine_code.compiling import inlined, internal

if TYPE_CHECKING:
    from numpy.random import Generator

_ADDRESSES = ("state", "next_uint64", "next_uint32", "next_double")

HANDLE = np.dtype([(name, np.uintp) for name in _ADDRESSES], align=True)


def handles_of(generators: Sequence[Generator]) -> NDArray[np.void]:
    """A handle for each generator, shape (n,); good for as long as the generators live."""
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
    """A generator as Numba has it, made of the four addresses."""

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


# Numba takes the first argument away, which type checkers cannot see.
_generator_of_addresses: Any = _generator


@internal
def generator_of(handle: Any) -> Generator:
    """The generator that a handle stands for, within compiled code."""
    generator: Generator = _generator_of_addresses(
        handle.state, handle.next_uint64, handle.next_uint32, handle.next_double
    )
    return generator


@inlined
def next_uniform(handle: Any) -> float:
    """The next number in [0, 1) of the generator that a handle stands for, as `random` has it."""
    return float(generator_of(handle).random())
