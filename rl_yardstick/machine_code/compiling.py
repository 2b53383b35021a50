"""The decorators of compiled functions, and a disk cache of machine code.

They keep the types of functions, which Numba's own would hide. Nothing compiles before the first
call. A function that only compiled functions call needs no machine code of its own, and no wrappers
for Python and C: such a `Part` is compiled to LLVM's intermediate representation (IR), and from
there into the code of each caller.

Numba discards cached code when the function's own file changes, but not when the file of an inlined
function does. So all code is in a folder named by a digest of all our sources and of compilers.
"""

# mypy: allow-untyped-calls

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from filelock import FileLock
from numba._dynfunc import make_function  # type: ignore[import-not-found]  # it is written in C
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.types import unliteral

from rl_yardstick.machine_code import WorkTime

ROOT = Path(__file__).resolve().parent.parent  # the folder of `rl_yardstick`, with all packages
# The packages with compiled functions; their machine code depends on no other package.
COMPILED = ("agents", "machine_code", "mdp")
OWN_MODULES = tuple(f"rl_yardstick.{package}." for package in COMPILED)

KEPT_BESIDE = 3  # folders of other digests to keep, for switching between versions
# The first field of a settings record starts with this; the algorithm's module and class follow.
RULE_PREFIX = "rule "
logger = logging.getLogger(__name__)


def digest() -> str:
    """Digest of sources and compilers as they are now, 16 hexadecimal digits."""
    settings: Any = numba.config
    compilers = [importlib.metadata.version(name) for name in ("numba", "numpy", "llvmlite")]
    options = platform.python_version(), settings.OPT, settings.BOUNDSCHECK
    found = hashlib.sha256(repr((compilers, options)).encode())
    for path in sorted(path for package in COMPILED for path in (ROOT / package).rglob("*.py")):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        found.update(f"{path.relative_to(ROOT).as_posix()} {content}\n".encode())
    return found.hexdigest()[:16]


@cache
def folder() -> Path | None:
    """The cache folder of this process's sources; None where none can be written."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    parents = [ROOT / "__pycache__" / "machine_code", Path(home) / "yardstick" / "machine_code"]
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        parents.insert(0, Path(given) / "yardstick")
    for parent in parents:
        chosen = parent / digest()
        try:
            chosen.mkdir(mode=0o700, parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=chosen).close()
            os.utime(chosen)
        except OSError:
            continue
        remove_old(chosen)
        return chosen
    logger.warning("no folder for machine code can be written: each process compiles anew")
    return None


def remove_old(used: Path) -> None:
    """Remove all folders beside ``used`` except the few that were used last."""
    others = [path for path in used.parent.iterdir() if path != used]
    for path in sorted(others, key=lambda path: path.stat().st_mtime_ns)[:-KEPT_BESIDE]:
        shutil.rmtree(path, ignore_errors=True)


class Locator(InTreeCacheLocator):
    """The place of one file's machine code, in the common folder."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Locator:
        locator = cls(py_func, py_file)
        locator._cache_path = f"{folder()}/{py_func.__module__}"  # wherever the package lies
        return locator

    def get_source_stamp(self) -> str:
        return ""  # the folder's name contains the digest of the sources


class Implementation(CompileResultCacheImpl):
    """Numba's cache of a compiled function, in the folder of `Locator`."""

    _locator_classes = [Locator]  # noqa: RUF012  # as Numba has it


class KeyedCache(FunctionCache):
    """Numba's cache of one function, used only where the digest covers the code."""

    _impl_class = Implementation

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The machine code for these argument types, or None where it has to be compiled."""
        found = super().load_overload(signature, target_context) if _is_keyed(signature) else None
        if found is None:
            logger.info("compiling %s", self._py_func.__qualname__)
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        """Cache the machine code, unless a source has changed since the process began."""
        place = Path(self.cache_path).parent
        if not _is_keyed(signature) or digest() != place.name:
            return
        try:
            # Numba would let two processes give one name to two pieces of code.
            with FileLock(place / ".lock", timeout=10):
                super().save_overload(signature, data)
        except (OSError, NotImplementedError) as error:  # a full disk: this process has the code
            logger.warning("the machine code of %s is not kept: %s", self._name, error)


def load_libraries() -> None:
    """Load what Numba needs for any function, before it is needed."""
    cpu_target.target_context.refresh()


def _is_keyed(signature: Any) -> bool:
    """Whether all rules are ours whose settings are among the arguments."""
    rules = re.findall(rf"{RULE_PREFIX}([\w.]+)", str(signature))
    return all(f"{module}.".startswith(OWN_MODULES) for module in rules)


def cache_of(function: Callable[..., object]) -> FunctionCache | NullCache:
    """The cache for a function's machine code: none for functions of users."""
    is_own = function.__module__.startswith(OWN_MODULES)
    return KeyedCache(function) if is_own and folder() is not None else NullCache()


Function = TypeVar("Function", bound=Callable[..., object])

IS_INTERPRETED: bool = bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]

# Division by zero follows IEEE 754 and raises nothing: checks for it hinder the optimiser.
OPTIONS: dict[str, Any] = {"error_model": "numpy"}

# Without reference counts, which cost a loop of small steps more than the steps themselves. Safe
# for functions that allocate nothing: their caller in Python keeps all arrays alive.
BARE_OPTIONS: dict[str, Any] = {**OPTIONS, "_nrt": False}

INLINED_OPTIONS: dict[str, Any] = {**BARE_OPTIONS, "forceinline": True}

# Without the wrapper that unpacks the arrays of a call, which takes longer to compile than a loop.
PART_OPTIONS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


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
        options = {"nopython": True, **options, **PART_OPTIONS}
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


def _decorator(options: dict[str, Any], *, is_part: bool = False) -> Callable[[Function], Function]:
    def decorated(function: Function) -> Function:
        if IS_INTERPRETED:
            return function
        if is_part:
            return cast(Function, Part(function, options))
        dispatcher = numba.njit(**options)(function)
        dispatcher._cache = cache_of(function)
        return cast(Function, dispatcher)

    return decorated


# Compiles a function of numbers and arrays on its first call.
compiled = _decorator(OPTIONS)
# Compiles a long loop that allocates nothing.
kernel = _decorator(BARE_OPTIONS)
# Compiles a function that allocates nothing and that only compiled functions call.
called = _decorator(BARE_OPTIONS, is_part=True)
# As `called`, for loops over single-precision numbers: sums in any order, fused multiply-add, no
# sign of zero.
vectorised = _decorator({**BARE_OPTIONS, "fastmath": {"reassoc", "contract", "nsz"}}, is_part=True)
# As `inlined`, for functions that Python does not call.
internal = _decorator(INLINED_OPTIONS, is_part=True)
# Compiles a function that returns a view of an array into its callers: without reference counts,
# only the caller's own code may make a view.
view = _decorator({**BARE_OPTIONS, "inline": "always"})


def inlined(function: Function) -> Function:
    """Compile a small function that allocates nothing into its callers."""
    if IS_INTERPRETED:
        return function
    part = cache(lambda: Part(function, INLINED_OPTIONS))
    dispatcher: Any = _decorator(INLINED_OPTIONS)(function)  # for Python; callers use the part
    dispatcher.get_call_template = lambda args, kws: part().get_call_template(args, kws)
    dispatcher.get_overload = lambda signature: part().get_overload(signature)
    return cast(Function, dispatcher)


class _CompileTimer(event.Listener):
    """Sums the compile time; a compilation within another counts once."""

    def __init__(self) -> None:
        self.depth = 0
        self.spent = WorkTime()

    def on_start(self, event: object) -> None:
        if self.depth == 0:
            self.spent -= WorkTime.now()
        self.depth += 1

    def on_end(self, event: object) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.spent += WorkTime.now()


@contextmanager
def compile_timer() -> Iterator[Callable[[], WorkTime]]:
    """Measure the compile time of a ``with`` statement by the function that it yields."""
    timer = _CompileTimer()
    with event.install_listener("numba:compile", timer):
        yield lambda: timer.spent
