"""Functions that are compiled as parts of others, and not by themselves.

For each function Numba makes machine code, with a wrapper for Python and another for C. Where only
compiled functions call it, all of that is thrown away: each of them compiles the function anew, as
a part of itself. Here compiling ends with what they need, LLVM's intermediate code. It is not kept
on disk: where the machine code of the whole is kept, nobody needs the parts.
"""

# mypy: allow-untyped-calls
# Numba's functions are not typed.

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba._dynfunc import make_function  # type: ignore[import-not-found]  # it is written in C
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.core.types import unliteral

# What unpacks the arrays of a call from Python takes longer to compile than a loop.
WITHOUT_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class PartLibrary(JITCodeLibrary):
    """Optimised intermediate code, of which no machine code is made."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


class PartCompiler(Compiler):
    """Numba's compiler, as far as intermediate code."""

    def __init__(self, typing_context: Any, target_context: Any, _: Any, *others: Any) -> None:
        library = PartLibrary(target_context.codegen(), "part")
        super().__init__(typing_context, target_context, library, *others)
        self.state.flags.no_compile = True

    def _compile_core(self) -> Any:
        result = super()._compile_core()
        # Calls find the code by what Python would call, which here leads nowhere.
        about, parts = result.fndesc, (result.library,)
        key = make_function(about.lookup_module(), about.qualname, "", 0, result.environment, parts)
        self.state.targetctx.insert_user_function(key, about, parts)
        return result._replace(entry_point=key)


class Part(CPUDispatcher):
    """A function as those see it that are compiled with it as a part."""

    def __init__(self, function: Callable[..., object], options: dict[str, Any]) -> None:
        options = {"nopython": True, **options, **WITHOUT_WRAPPERS}
        super().__init__(function, targetoptions=options, pipeline_class=PartCompiler)

    def add_overload(self, result: Any) -> None:
        """Keep the code where compiled functions find it, and Python does not."""
        self.overloads[tuple(result.signature.args)] = result

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        raise TypeError(f"only compiled functions can call {self.py_func.__qualname__}")

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Types of the call; numbers that are written out have no type of their own."""
        kws = {name: unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template([unliteral(kind) for kind in args], kws)


def called_as_part(dispatcher: Any, options: dict[str, Any]) -> Any:
    """Let compiled functions have a function as a part that Python calls as it is."""

    @cache
    def part() -> Part:
        return Part(dispatcher.py_func, options)

    dispatcher.get_call_template = lambda args, kws: part().get_call_template(args, kws)
    dispatcher.get_overload = lambda signature: part().get_overload(signature)
    return dispatcher
