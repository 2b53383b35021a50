"""Lets compiled functions draw from NumPy's random generators.

Passing a `numpy.random.Generator` to a compiled function takes longer than a training step, and an
array cannot hold generators. A handle is a record of the four addresses that drawing needs: the
generator's state and three functions. Drawing by a handle gives the generator's own next number.

Calling such a function takes longer than drawing. So this module implements PCG64, which NumPy's
`default_rng` and Gymnasium use, and a handle has the address of its 256 bits. We use the address
only if its bytes equal `bit_generator.state`.

Source: O'Neill, PCG: A Family of Simple Fast Space-Efficient Statistically Good Algorithms for
Random Number Generation (2014), XSL-RR 128/64.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.random import PCG64
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import inlined, internal

if TYPE_CHECKING:
    from numpy.random import Generator

_ADDRESSES = ("state", "next_uint64", "next_uint32", "next_double")

_PCG64 = "pcg64"  # address of its state and increment, 0 for other generators

HANDLE = np.dtype([(name, np.uintp) for name in (*_ADDRESSES, _PCG64)], align=True)

_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645

ir = vars(cgutils)["ir"]  # llvmlite's, which comes with Numba
_WORD, _WIDE = ir.IntType(64), ir.IntType(128)


def handles_of(generators: Sequence[Generator]) -> NDArray[np.void]:
    """A handle for each generator, shape (n,); valid while the generators exist."""
    handles = np.zeros(len(generators), dtype=HANDLE)
    for handle, generator in zip(handles, generators, strict=True):
        bits: Any = generator.bit_generator.ctypes
        handle["state"] = bits.state_address
        for name in _ADDRESSES[1:]:
            handle[name] = ctypes.cast(getattr(bits, name), ctypes.c_void_p).value or 0
        handle[_PCG64] = _place_of_pcg64(generator.bit_generator)
    return handles


def _place_of_pcg64(bits: Any) -> int:
    """The address of PCG64's state and increment; 0 for other generators, or if in doubt."""
    if type(bits) is not PCG64 or sys.byteorder != "little":
        return 0
    place = ctypes.cast(bits.ctypes.state_address, ctypes.POINTER(ctypes.c_void_p))[0] or 0
    told = bits.state["state"]
    lies_there = b"".join(told[name].to_bytes(16, "little") for name in ("state", "inc"))
    return place if place and ctypes.string_at(place, 32) == lies_there else 0


def _stepped(builder: Any, place: Any) -> Any:
    """The state of the PCG64 at that address, after one step."""
    state_at = builder.inttoptr(place, _WIDE.as_pointer())
    increment_at = builder.gep(state_at, [ir.Constant(_WORD, 1)])
    state = builder.load(state_at, align=8)
    increment = builder.load(increment_at, align=8)
    state = builder.add(builder.mul(state, ir.Constant(_WIDE, _MULTIPLIER)), increment)
    builder.store(state, state_at, align=8)
    return state


@intrinsic
def _step_of_pcg64(typing_context: Any, place: Any) -> Any:
    """Advance the PCG64 at that address by one step."""

    def build(context: Any, builder: Any, signature: Any, places: Any) -> Any:
        _stepped(builder, places[0])
        return context.get_dummy_value()

    return types.void(types.uintp), build


@intrinsic
def _pcg64(typing_context: Any, place: Any) -> Any:
    """The next double of the PCG64 at that address."""

    def build(context: Any, builder: Any, signature: Any, places: Any) -> Any:
        state = _stepped(builder, places[0])
        high = builder.trunc(builder.lshr(state, ir.Constant(_WIDE, 64)), _WORD)
        mixed = builder.xor(high, builder.trunc(state, _WORD))
        turn = builder.lshr(high, ir.Constant(_WORD, 58))
        back = builder.and_(builder.neg(turn), ir.Constant(_WORD, 63))
        bits = builder.or_(builder.lshr(mixed, turn), builder.shl(mixed, back))
        whole = builder.uitofp(builder.lshr(bits, ir.Constant(_WORD, 11)), ir.DoubleType())
        return builder.fmul(whole, ir.Constant(ir.DoubleType(), 2.0**-53))

    return types.float64(types.uintp), build


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
_pcg64_at: Any = _pcg64
_step_at: Any = _step_of_pcg64


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
    if handle.pcg64 != 0:
        return float(_pcg64_at(handle.pcg64))
    return float(generator_of(handle).random())


@inlined
def skip_uniform(handle: Any) -> None:
    """Advance the handle's generator by one number."""
    if handle.pcg64 != 0:
        _step_at(handle.pcg64)
    else:
        generator_of(handle).random()
