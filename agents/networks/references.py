"""Named tuples and functions that compiled functions are handed by address.

LLVM optimises a function anew as a part of each that calls it, and Numba hands a named tuple on as
all the numbers that its arrays are described by. With a learner of thirty arrays, four calls below
the loop, compiling takes the better part of a minute. A reference is one address: compiled
functions read ``reference.name`` from there, as they would from the tuple. What learning comes to
lies behind an address as well, so that it is compiled by itself, and once for all environments.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

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

from machine_code.compiling import internal

ir: Any = vars(cgutils)["ir"]  # llvmlite's, which comes with Numba

# Numba ships no types.
typeof: Any = _typeof
_typed_unbox: Any = unbox
_typed_getattr: Any = lower_getattr_generic

# All that is in a tuple is made of these.
WORD = 8


class Reference:
    """A named tuple of arrays and numbers, to be handed on by address.

    Args:
        held: the named tuple, whose parts may be such tuples as well; arrays stay where they are.

    Attributes:
        held: the same; its arrays live as long as the reference.
        address: where compiled functions find it.
        kind: Numba's type of the reference.

    Raises:
        TypeError: if a part is anything else.
    """

    def __init__(self, held: Any) -> None:
        self.held = held
        self._words = np.array(list(_words(held)), dtype=np.int64)
        self.address = int(self._words.ctypes.data)
        # To find it takes Numba longer than most functions that a reference is handed to.
        self.kind = ReferenceType(typeof(held))

    def hold(self, held: Any) -> None:
        """Refer to another tuple of the same kind from now on, at the same address."""
        self.held = held
        self._words[:] = list(_words(held))


def _words(value: Any) -> Iterator[int]:
    """What Numba keeps of a value in memory."""
    if isinstance(value, tuple):
        for part in value:
            yield from _words(part)
    elif isinstance(value, np.ndarray):
        # Nobody counts references here.
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data)
        yield from value.shape
        yield from value.strides
    elif isinstance(value, float):
        yield int(np.float64(value).view(np.int64))
    elif isinstance(value, int | np.uintp) and not isinstance(value, bool):
        yield int(value)
    else:
        raise TypeError(f"a reference cannot hold {type(value).__name__}")


def _n_words(kind: Any) -> int:
    """How many words Numba keeps of a value of that type."""
    if hasattr(kind, "instance_class"):
        return sum(_n_words(part) for part in kind.types)
    return 5 + 2 * int(kind.ndim) if hasattr(kind, "ndim") else 1


class ReferenceType(types.Type):
    """The type of a reference.

    Args:
        content: the type of what it holds.

    Attributes:
        content: the same.
        types: the same, for what looks into the parts of types.
    """

    def __init__(self, content: Any) -> None:
        self.content = content
        self.types = (content,)
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
    """Where the machine code of a compiled function lies, for `call`.

    Args:
        function: of a reference and two floating-point numbers, with a whole number as its result.
        reference: what it is to be called with.
    """
    arguments = reference.kind, types.float64, types.float64
    code = function.get_compile_result(types.int64(*arguments))
    name = code.fndesc.llvm_cfunc_wrapper_name
    return np.uintp(code.library.get_pointer_to_function(name))


@intrinsic
def _call(typing_context: Any, address: Any, reference: Any, first: Any, second: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, reference, *numbers = arguments
        if isinstance(reference.type, ir.IntType):
            reference = builder.inttoptr(reference, cgutils.voidptr_t)
        passed = [reference, *numbers]
        kind = ir.FunctionType(ir.IntType(64), [value.type for value in passed])
        return builder.call(builder.inttoptr(address, kind.as_pointer()), passed)

    return types.int64(types.uintp, reference, types.float64, types.float64), build


# Numba takes the first argument away, which type checkers cannot see.
_call_address: Any = _call


@internal
def call(address: Any, reference: Any, first: float, second: float) -> int:
    """Call what `address_of` has found, with a reference or the address of one."""
    result: int = _call_address(address, reference, first, second)
    return result
