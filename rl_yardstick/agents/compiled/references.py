"""What compiled functions get by address: random generators, named tuples and other functions."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import typeof as _typeof
from numba.core import cgutils, types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import inlined, internal

if TYPE_CHECKING:
    from numpy.random import Generator


_intrinsic: Any = intrinsic  # it removes the first argument, which type checkers cannot know
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


@_intrinsic  # type: ignore[untyped-decorator]
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


@internal
def generator_of(handle: Any) -> Generator:
    """The generator of a handle, for use in compiled code."""
    generator: Generator = _generator(
        handle.state, handle.next_uint64, handle.next_uint32, handle.next_double
    )
    return generator


@inlined
def next_uniform(handle: Any) -> float:
    """Draw a number in [0, 1) from the handle's generator, like `Generator.random`."""
    return float(generator_of(handle).random())


ir: Any = vars(cgutils)["ir"]  # llvmlite's, which comes with Numba

# Numba ships no types.
typeof: Any = _typeof
_typed_unbox: Any = unbox
_typed_getattr: Any = lower_getattr_generic

# All parts of a tuple consist of words of this many bytes.
WORD = 8


class Reference:
    """A named tuple of arrays, records and numbers, to pass by address; records are copied."""

    def __init__(self, held: Any) -> None:
        self.held = held  # the tuple; its arrays live as long as the reference
        self._words = np.array(list(_words(held)), dtype=np.int64)
        self.address = int(self._words.ctypes.data)  # for compiled functions
        # Stored, because `typeof` takes longer than most functions that get a reference.
        self.kind = ReferenceType(typeof(held))  # Numba's type of the reference

    def hold(self, held: Any) -> None:
        """Refer to another tuple of the same kind, at the same address."""
        self.held = held
        self._words[:] = list(_words(held))


def _words(value: Any) -> Iterator[int]:
    """The words of a value in Numba's memory layout."""
    if isinstance(value, np.void):
        content = value.tobytes()
        yield from np.frombuffer(content + bytes(-len(content) % WORD), np.int64).tolist()
        return
    if isinstance(value, tuple):
        for part in value:
            yield from _words(part)
    elif isinstance(value, np.ndarray):
        # The first two words are zero: references are not counted here.
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data)
        yield from value.shape
        yield from value.strides
    elif isinstance(value, float):
        yield int(np.float64(value).view(np.int64))
    else:
        yield int(value)


def _n_words(kind: Any) -> int:
    """The number of words of a value of this type in Numba's memory layout."""
    if isinstance(kind, types.Record):
        return -(-kind.size // WORD)
    if isinstance(kind, types.BaseTuple):
        parts: Any = kind
        return sum(map(_n_words, parts.types))
    return 5 + 2 * int(kind.ndim) if hasattr(kind, "ndim") else 1


class ReferenceType(types.Type):
    """The type of a reference."""

    def __init__(self, content: Any) -> None:
        self.content = content
        self.types = (content,)  # for code that inspects the parts of types
        super().__init__(name=f"Reference({content})")


@typeof_impl.register(Reference)
def _type_of(value: Reference, context: Any) -> ReferenceType:
    return value.kind


register_model(ReferenceType)(models.OpaqueModel)


@_typed_unbox(ReferenceType)  # type: ignore[untyped-decorator]
def _unbox(kind: Any, value: Any, c: Any) -> Any:
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_ulonglong(number)
    c.pyapi.decref(number)
    native: Any = NativeValue
    return native(c.builder.inttoptr(address, cgutils.voidptr_t))


@infer_getattr
class _Attributes(AttributeTemplate):
    key = ReferenceType

    def generic_resolve(self, kind: Any, name: str) -> Any:  # type: ignore[override]
        fields = kind.content.fields
        return kind.content.types[fields.index(name)] if name in fields else None


@_typed_getattr(ReferenceType)  # type: ignore[untyped-decorator]
def _read(context: Any, builder: Any, kind: Any, address: Any, name: str) -> Any:
    fields, parts = kind.content.fields, kind.content.types
    index = fields.index(name)
    offset = WORD * sum(_n_words(part) for part in parts[:index])
    model = context.data_model_manager[parts[index]]
    pointer_add: Any = cgutils.pointer_add
    place = pointer_add(builder, address, offset, model.get_data_type().as_pointer())
    return model.load_from_data_pointer(builder, place)


def address_of(function: Any, reference: Reference) -> np.uintp:
    """The address of a compiled function's machine code, for `call`."""
    arguments = reference.kind, types.float64, types.float64
    code = function.get_compile_result(types.int64(*arguments))
    name = code.fndesc.llvm_cfunc_wrapper_name
    return np.uintp(code.library.get_pointer_to_function(name))


@_intrinsic  # type: ignore[untyped-decorator]
def _call(typing_context: Any, address: Any, reference: Any, first: Any, second: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, reference, *numbers = arguments
        if isinstance(reference.type, ir.IntType):
            reference = builder.inttoptr(reference, cgutils.voidptr_t)
        passed = [reference, *numbers]
        kind = ir.FunctionType(ir.IntType(64), [value.type for value in passed])
        return builder.call(builder.inttoptr(address, kind.as_pointer()), passed)

    return types.int64(types.uintp, reference, types.float64, types.float64), build


@internal
def call(address: Any, reference: Any, first: float, second: float) -> int:
    """Call the function at an address of `address_of`, with a reference or its address."""
    result: int = _call(address, reference, first, second)
    return result
