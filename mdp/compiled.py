"""The decorator of every compiled function.

Numba ships no type annotations, so that its own decorator would hide the signatures of the
functions under it. ``compiled`` keeps them, and holds the options in one place: the machine code is
cached beside the source, nothing compiles before the first call, and floating-point arithmetic
stays as IEEE 754 has it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays on its first call."""
    return cast(Function, numba.njit(cache=True)(function))
