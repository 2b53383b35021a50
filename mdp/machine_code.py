"""The decorator of every compiled function.

Numba ships no type annotations, so that its own decorator would hide the signatures of the
functions under it. ``compiled`` keeps them, and holds the options in one place: the machine code is
cached beside the source, nothing compiles before the first call, and floating-point arithmetic
stays as IEEE 754 has it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


# Division by zero gives what IEEE 754 says and raises nothing: checks for it would keep the
# compiler from seeing through a function that is called by another.
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}

# Without reference counts, which cost a loop of small steps more than the steps themselves. Right
# for functions that allocate nothing: their caller in Python keeps all arrays alive.
_BARE_OPTIONS: dict[str, Any] = {**_OPTIONS, "_nrt": False}


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays on its first call."""
    return cast(Function, numba.njit(**_OPTIONS)(function))


def kernel(function: Function) -> Function:
    """Compile a long loop that allocates nothing."""
    return cast(Function, numba.njit(**_BARE_OPTIONS)(function))


def inlined(function: Function) -> Function:
    """Compile a small function that allocates nothing, as a part of those that call it."""
    return cast(Function, numba.njit(**_BARE_OPTIONS, forceinline=True)(function))
