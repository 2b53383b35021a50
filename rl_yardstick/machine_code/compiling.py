"""The decorators of compiled functions.

Numba's own decorator would hide the signatures of functions. These keep them, and set the options
in one place: machine code is cached by `machine_code.cache`, nothing compiles before the first
call, and floating-point arithmetic follows IEEE 754.

For each function Numba makes machine code, with a wrapper for Python and another for C. A function
that only compiled functions call needs none of these: each caller compiles it into its own code.
Such a `Part` is compiled only to LLVM's intermediate representation (IR), and not cached on disk,
since the cached code of its callers contains it.
"""

# mypy: allow-untyped-calls
# Numba's functions are not typed.

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar, cast

import numba
from numba._dynfunc import make_function  # type: ignore[import-not-found]  # it is written in C
from numba.core import event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.core.types import unliteral

from rl_yardstick.machine_code import WorkTime
from rl_yardstick.machine_code.cache import cache_of

Function = TypeVar("Function", bound=Callable[..., object])

# Division by zero follows IEEE 754 and raises nothing: checks for it would hinder the compiler in
# optimising across calls.
OPTIONS: dict[str, Any] = {"error_model": "numpy"}

# Without reference counts, which cost a loop of small steps more than the steps themselves. Safe
# for functions that allocate nothing: their caller in Python keeps all arrays alive.
BARE_OPTIONS: dict[str, Any] = {**OPTIONS, "_nrt": False}

# Fast-math flags for single precision, so that loops are vectorised: sums in any order, fused
# multiply-add, and no sign of zero. Infinities and NaN keep their meaning.
REORDERED_OPTIONS: dict[str, Any] = {**BARE_OPTIONS, "fastmath": {"reassoc", "contract", "nsz"}}

INLINED_OPTIONS: dict[str, Any] = {**BARE_OPTIONS, "forceinline": True}


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


def inlined(function: Function) -> Function:
    """Compile a small function that allocates nothing into its callers."""
    if is_interpreted():
        return function
    return cast(Function, called_as_part(_decorated(function, INLINED_OPTIONS), INLINED_OPTIONS))


def internal(function: Function) -> Function:
    """As `inlined`, for functions that Python does not call."""
    return _part(function, INLINED_OPTIONS)


def view(function: Function) -> Function:
    """Compile a function that returns a view of an array into its callers.

    Without reference counts, only the caller's own code may make a view.
    """
    return _decorated(function, {**BARE_OPTIONS, "inline": "always"})


def is_interpreted() -> bool:
    """Whether NUMBA_DISABLE_JIT turns compiling off."""
    return bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]


def _part(function: Function, options: dict[str, Any]) -> Function:
    return function if is_interpreted() else cast(Function, Part(function, options))


def _decorated(function: Function, options: dict[str, Any]) -> Function:
    if is_interpreted():
        return function
    dispatcher = numba.njit(**options)(function)
    dispatcher._cache = cache_of(function)
    return cast(Function, dispatcher)


# The time that compiling takes.


class _CompileTimer(event.Listener):
    """Sums the compile time; a compilation within another counts once."""

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
    """Measure the compile time of a ``with`` statement, to leave it out of other timings.

    Yields:
        A function that returns the compile time so far.
    """
    timer = _CompileTimer()
    with event.install_listener("numba:compile", timer):
        yield lambda: timer.spent


# Functions compiled into others.

# The wrapper that unpacks the arrays of a call from Python takes longer to compile than a loop.
WITHOUT_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class PartLibrary(JITCodeLibrary):
    """Optimised IR, without machine code."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


class PartCompiler(Compiler):
    """Numba's compiler up to the IR."""

    def __init__(self, typing_context: Any, target_context: Any, _: Any, *others: Any) -> None:
        library = PartLibrary(target_context.codegen(), "part")
        super().__init__(typing_context, target_context, library, *others)
        self.state.flags.no_compile = True

    def _compile_core(self) -> Any:
        result = super()._compile_core()
        # Numba finds code by its Python entry point; this entry point is a dummy.
        about, parts = result.fndesc, (result.library,)
        key = make_function(about.lookup_module(), about.qualname, "", 0, result.environment, parts)
        self.state.targetctx.insert_user_function(key, about, parts)
        return result._replace(entry_point=key)


class Part(CPUDispatcher):
    """A function that is compiled into its callers only."""

    def __init__(self, function: Callable[..., object], options: dict[str, Any]) -> None:
        options = {"nopython": True, **options, **WITHOUT_WRAPPERS}
        super().__init__(function, targetoptions=options, pipeline_class=PartCompiler)

    def add_overload(self, result: Any) -> None:
        """Store the code where compiled functions find it, and Python does not."""
        self.overloads[tuple(result.signature.args)] = result

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        raise TypeError(f"only compiled functions can call {self.py_func.__qualname__}")

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """The types of a call, with the types of literals replaced by those of variables."""
        kws = {name: unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template([unliteral(kind) for kind in args], kws)


def called_as_part(dispatcher: Any, options: dict[str, Any]) -> Any:
    """Let compiled callers use a `Part` of a function that Python calls as it is."""

    @cache
    def part() -> Part:
        return Part(dispatcher.py_func, options)

    dispatcher.get_call_template = lambda args, kws: part().get_call_template(args, kws)
    dispatcher.get_overload = lambda signature: part().get_overload(signature)
    return dispatcher
