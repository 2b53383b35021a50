"""A disk cache of machine code, in a folder that is named by the sources.

Numba caches the machine code of a function, and discards it when the function's own file changes.
It misses changes in a function of another file that was inlined. Here the cache of all functions
is in a folder named by a digest of every source that the machine code depends on, and of the
versions of Python, Numba and NumPy. After a change of a source the digest differs, so stale code
is never loaded. Numba itself keeps the code of different processors apart.

Code that depends on other sources, such as a user's own update rule, is not cached.
"""

# mypy: allow-untyped-calls
# Numba's classes are not typed.

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator, NullCache

from rl_yardstick.machine_code.sources import ROOT, source_digest

# The packages with compiled functions; their machine code depends on no other package.
COMPILED = ("agents", "machine_code", "mdp")
OWN_MODULES = tuple(f"rl_yardstick.{package}." for package in COMPILED)

# Folders of other digests to keep, for switching between versions.
KEPT_BESIDE = 3

# The first field of a settings record starts with this; the algorithm's module and class follow.
RULE_PREFIX = "rule "

logger = logging.getLogger(__name__)


def digest() -> str:
    """Digest of sources and compilers as they are now."""
    settings: Any = numba.config
    compilers = [importlib.metadata.version(name) for name in ("numba", "numpy", "llvmlite")]
    options = platform.python_version(), str(settings.OPT), str(settings.BOUNDSCHECK)
    return source_digest(COMPILED, *compilers, *options)


def parents() -> Iterator[Path]:
    """Folders that may hold the cache, the best first."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        yield Path(given) / "yardstick"
    yield ROOT / "__pycache__" / "machine_code"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    yield Path(home) / "yardstick" / "machine_code"


@cache
def folder() -> Path | None:
    """The cache folder of this process's sources; None where none can be written."""
    for parent in parents():
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


def is_compiled_before(name: str) -> bool:
    """Whether the cache holds machine code of a function, for any argument types."""
    found = folder()
    return found is not None and any(found.glob(f"*/*.{name}-*.nbi"))


def modules_of(kind: Any) -> Iterator[str]:
    """The modules that define the classes and rules in argument types, or in one such type."""
    if isinstance(kind, tuple | list):
        for part in kind:
            yield from modules_of(part)
        return
    instance_class = getattr(kind, "instance_class", None)
    if instance_class not in (None, tuple):
        yield instance_class.__module__
    for name in getattr(kind, "fields", ()):
        if isinstance(name, str) and name.startswith(RULE_PREFIX):
            yield name.removeprefix(RULE_PREFIX).partition(" ")[0]
    for part in (getattr(kind, "dtype", None), *getattr(kind, "types", ())):
        if part is not None and part is not kind:
            yield from modules_of(part)


class Locator(InTreeCacheLocator):
    """The cache folder of one function's file."""

    def __init__(self, function: Callable[..., object], file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(Path(str(folder())) / self.get_suitable_cache_subpath(file))

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Locator:
        return cls(py_func, py_file)

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
        if not _is_keyed(signature) or digest() != Path(self.cache_path).parent.name:
            return
        try:
            super().save_overload(signature, data)
        except OSError as error:  # such as a full disk; this process still has the code
            logger.warning("the machine code of %s is not kept: %s", self._name, error)


def cache_of(function: Callable[..., object]) -> FunctionCache | NullCache:
    """The cache for a function's machine code: none for functions of users."""
    is_own = function.__module__.startswith(OWN_MODULES)
    return KeyedCache(function) if is_own and folder() is not None else NullCache()


def _is_keyed(signature: Any) -> bool:
    arguments = getattr(signature, "args", signature)
    return all(f"{module}.".startswith(OWN_MODULES) for module in modules_of(arguments))
