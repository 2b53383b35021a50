"""The decorators of compiled functions.

Numba ships no type annotations, so that its own decorator would hide the signatures of the
functions under it. These keep them, and hold the options in one place: the machine code is kept as
`mdp.code_cache` says, nothing compiles before the first call, and floating-point arithmetic stays
as IEEE 754 has it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event

from mdp.code_cache import PACKAGES, CheckedCache, OwnCache, folder, numba_cache_dir
from mdp.code_parts import Part, called_as_part
from mdp.source_files import ROOT
from mdp.work_time import WorkTime

Function = TypeVar("Function", bound=Callable[..., object])


# Division by zero gives what IEEE 754 says and raises nothing: checks for it would keep the
# compiler from seeing through a function that is called by another.
OPTIONS: dict[str, Any] = {"error_model": "numpy"}

# Without reference counts, which cost a loop of small steps more than the steps themselves. Right
# for functions that allocate nothing: their caller in Python keeps all arrays alive.
BARE_OPTIONS: dict[str, Any] = {**OPTIONS, "_nrt": False}


# What arithmetic in single precision may do besides, so that many numbers are worked out at once:
# take sums in any order, multiply and add in one go, and forget the sign of a zero. Numbers that
# are not finite stay what they are.
REORDERED_OPTIONS: dict[str, Any] = {**BARE_OPTIONS, "fastmath": {"reassoc", "contract", "nsz"}}


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays on its first call."""
    return _decorated(function, OPTIONS)


def kernel(function: Function) -> Function:
    """Compile a long loop that allocates nothing."""
    return _decorated(function, BARE_OPTIONS)


def called(function: Function) -> Function:
    """Compile a function that allocates nothing and that only compiled functions call."""
    return _part(function, BARE_OPTIONS)


def vectorised(function: Function) -> Function:
    """As `called`, for loops over single-precision numbers whose sums may be in any order."""
    return _part(function, REORDERED_OPTIONS)


INLINED_OPTIONS: dict[str, Any] = {**BARE_OPTIONS, "forceinline": True}


def inlined(function: Function) -> Function:
    """Compile a small function that allocates nothing, as a part of those that call it."""
    if is_interpreted():
        return function
    return cast(Function, called_as_part(_decorated(function, INLINED_OPTIONS), INLINED_OPTIONS))


def internal(function: Function) -> Function:
    """As `inlined`, for functions that Python does not call."""
    return _part(function, INLINED_OPTIONS)


def view(function: Function) -> Function:
    """Compile a function that returns a part of an array, as a part of those that call it.

    Without reference counts, only the caller's own code may make such a thing.
    """
    return _decorated(function, {**BARE_OPTIONS, "inline": "always"})


class _CompileTimer(event.Listener):
    """Adds up what compiling takes; functions that are compiled for others count once."""

    def __init__(self) -> None:
        self.depth = 0
        self.began = self.spent = WorkTime()

    def on_start(self, event: object) -> None:
        if self.depth == 0:
            self.began = WorkTime.now()
        self.depth += 1

    def on_end(self, event: object) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.spent += WorkTime.now() - self.began


@contextmanager
def compile_timer() -> Iterator[Callable[[], WorkTime]]:
    """Let a caller leave the time of compiling, which is spent once, out of what it measures.

    Yields:
        A function that tells how much time has gone into compiling in the ``with`` statement.
    """
    timer = _CompileTimer()
    with event.install_listener("numba:compile", timer):
        yield lambda: timer.spent


def is_interpreted() -> bool:
    """Whether Python itself is to run everything, as NUMBA_DISABLE_JIT asks for."""
    return bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]


def _part(function: Function, options: dict[str, Any]) -> Function:
    return function if is_interpreted() else cast(Function, Part(function, options))


def _decorated(function: Function, options: dict[str, Any]) -> Function:
    if is_interpreted():
        return function
    kept_in = folder() if _is_own(function) else None
    dispatcher = numba.njit(**options)(function)
    if kept_in is not None:
        with numba_cache_dir(kept_in):
            dispatcher._cache = OwnCache(function)
    dispatcher._cache = CheckedCache(dispatcher._cache, function.__qualname__)
    return cast(Function, dispatcher)


def _is_own(function: Callable[..., object]) -> bool:
    """Whether the function stands in a source that the digest of the cache covers."""
    try:
        place = Path(inspect.getfile(function)).resolve().relative_to(ROOT)
    except (TypeError, ValueError):
        return False
    return place.parts[0] in PACKAGES
