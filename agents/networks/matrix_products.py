"""Products of matrices in single precision, by the BLAS that SciPy brings.

Numba's own `numpy.dot` wants to count references, which compiled loops here do without. BLAS counts
by columns, so that it is handed the transposed problem: the rows of one matrix are its columns.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import get_cython_function_address, intrinsic
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from machine_code.compiling import internal

Singles = NDArray[np.float32]

ir: Any = vars(cgutils)["ir"]  # llvmlite's, which comes with Numba

AS_IT_IS = ord("N")
TRANSPOSED = ord("T")


@cache
def _controller() -> ThreadpoolController:
    # SciPy's BLAS is there by now: it has been asked for its address.
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[Any]:
    """Let BLAS work in one thread for a while.

    Matrices are too small for more to pay, and with several the last bits depend on their number.
    """
    sgemm_address()
    limited: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limited


def sgemm_address() -> np.uintp:
    """Where BLAS's routine lies in this process, for compiled functions to call."""
    return np.uintp(get_cython_function_address("scipy.linalg.cython_blas", "sgemm"))


@intrinsic
def _sgemm(
    typing_context: Any,
    address: Any,
    first_kind: Any,
    second_kind: Any,
    m: Any,
    n: Any,
    k: Any,
    first: Any,
    first_stride: Any,
    second: Any,
    second_stride: Any,
    product: Any,
    product_stride: Any,
) -> Any:
    """BLAS's ``sgemm``, without the factors: all it is given are addresses of numbers."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, first_kind, second_kind, *numbers = arguments
        m, n, k, first, first_stride, second, second_stride, product, product_stride = numbers
        place: Any = cgutils.alloca_once_value
        single, integer, character = ir.FloatType(), ir.IntType(32), ir.IntType(8)

        def kept(value: Any, kind: Any) -> Any:
            return place(builder, builder.trunc(value, kind))

        def matrix(value: Any) -> Any:
            return builder.inttoptr(value, single.as_pointer())

        one, zero = (place(builder, ir.Constant(single, factor)) for factor in (1.0, 0.0))
        passed = [
            kept(first_kind, character),
            kept(second_kind, character),
            *(kept(size, integer) for size in (m, n, k)),
            one,
            matrix(first),
            kept(first_stride, integer),
            matrix(second),
            kept(second_stride, integer),
            zero,
            matrix(product),
            kept(product_stride, integer),
        ]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in passed])
        builder.call(builder.inttoptr(address, kind.as_pointer()), passed)
        return context.get_dummy_value()

    size, place = types.int64, types.uintp
    return (
        types.void(place, size, size, size, size, size, place, size, place, size, place, size),
        build,
    )


# Numba takes the first argument away, which type checkers cannot see.
_call: Any = _sgemm


@internal
def _multiply(
    sgemm: Any, left: Singles, left_kind: int, right: Singles, right_kind: int, product: Singles
) -> None:
    """The product of two matrices, each as it is or transposed."""
    m, n = product.shape
    inner = left.shape[1] if left_kind == AS_IT_IS else left.shape[0]
    _call(
        sgemm,
        right_kind,
        left_kind,
        n,
        m,
        inner,
        right.ctypes.data,
        right.shape[1],
        left.ctypes.data,
        left.shape[1],
        product.ctypes.data,
        n,
    )


@internal
def multiply(sgemm: Any, left: Singles, right: Singles, product: Singles) -> None:
    """``product = left @ right``, of shapes (m, k), (k, n) and (m, n)."""
    _multiply(sgemm, left, AS_IT_IS, right, AS_IT_IS, product)


@internal
def multiply_transposed_left(sgemm: Any, left: Singles, right: Singles, product: Singles) -> None:
    """``product = left.T @ right``, of shapes (k, m), (k, n) and (m, n)."""
    _multiply(sgemm, left, TRANSPOSED, right, AS_IT_IS, product)


@internal
def multiply_transposed_right(sgemm: Any, left: Singles, right: Singles, product: Singles) -> None:
    """``product = left @ right.T``, of shapes (m, k), (n, k) and (m, n)."""
    _multiply(sgemm, left, AS_IT_IS, right, TRANSPOSED, product)
