"""A disk cache of machine code, in a folder that is named by the sources.

Numba discards the cached code of a function when the function's own file changes, but not when an
inlined function of another file does. So all code is in a folder named by a digest of every source
that it depends on, and of the versions of Python, Numba and NumPy. Numba itself keeps the code of
different processors apart. Code with other sources, such as a user's update rule, is not cached.
"""

# mypy: allow-untyped-calls
# Numba's classes are not typed.

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator, NullCache

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
        locator._cache_path = f"{folder()}/{locator.get_suitable_cache_subpath(py_file)}"
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
        if not _is_keyed(signature) or digest() != Path(self.cache_path).parent.name:
            return
        try:
            super().save_overload(signature, data)
        except OSError as error:  # such as a full disk; this process still has the code
            logger.warning("the machine code of %s is not kept: %s", self._name, error)


def _is_keyed(signature: Any) -> bool:
    """Whether all rules are ours whose settings are among the arguments."""
    rules = re.findall(rf"{RULE_PREFIX}([\w.]+)", str(signature))
    return all(f"{module}.".startswith(OWN_MODULES) for module in rules)


def cache_of(function: Callable[..., object]) -> FunctionCache | NullCache:
    """The cache for a function's machine code: none for functions of users."""
    is_own = function.__module__.startswith(OWN_MODULES)
    return KeyedCache(function) if is_own and folder() is not None else NullCache()
