"""A disk cache of machine code, and when its files may be used.

Numba caches the machine code of a function beside its source file, and discards it when that file
changes. It misses changes in a function of another file that was inlined. Here the machine code of
a package is in a folder named by a digest of every source that the code depends on, and of the
versions of Python, Numba and NumPy. After a change of a source the digest differs, so stale code
is never loaded. Numba itself keeps the code of different processors apart.

Code that depends on other sources, such as a user's own update rule, is not cached, nor is code
compiled in a process whose sources have changed since it began. Without a writable folder, nothing
is cached.

Numba unpickles cache files, which can run any code. So a folder is used only if nobody but the user
and root can add a file to it or replace it; and a file only if it belongs to the user.
"""

# mypy: allow-untyped-calls
# Numba's classes are not typed.

from __future__ import annotations

import contextlib
import importlib.metadata
import inspect
import logging
import os
import platform
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
    _CacheLocator,
)

from rl_yardstick.machine_code.sources import (
    ROOT,
    content_lines,
    digest_of,
    kept_packages,
    source_paths,
)

# Folders of other digests to keep, for switching between versions.
KEPT_BESIDE = 3

# An upper bound on the length of Numba's file and folder names for one function. Windows allows
# paths of 260 characters, which an environment in a deep folder may exceed.
LONGEST_NAME = 120

# The first field of a settings record starts with this; the algorithm's module and class follow.
RULE_PREFIX = "rule "

logger = logging.getLogger(__name__)

Stamps = tuple[tuple[str, int, int], ...]


# The cache key.


def source_stamps(package: str) -> Stamps:
    """Path, modification time in nanoseconds and size of every source, ordered by path."""
    paths = source_paths(kept_packages()[package])
    return tuple((str(path), (at := path.stat()).st_mtime_ns, at.st_size) for path in paths)


@cache
def stamps_at_start(package: str) -> Stamps:
    """The stamps at the first call in this process."""
    return source_stamps(package)


@cache
def digest(package: str) -> str:
    """Digest of a package's sources and compilers; Numba itself tells processors apart."""
    compilers = ("numba", "numpy", "llvmlite")
    lines = [f"{name} {importlib.metadata.version(name)}" for name in compilers]
    lines.append(f"python {platform.python_version()}")
    settings: Any = numba.config
    lines.append(f"optimised {settings.OPT}, bounds checked {settings.BOUNDSCHECK}")
    # Sources are stamped before they are read: later changes are noticed.
    lines += content_lines(Path(path) for path, _, _ in stamps_at_start(package))
    return digest_of(lines)


def package_of(function: Callable[..., object]) -> str | None:
    """The package in which a function stands, if its machine code is kept."""
    try:
        place = Path(inspect.getfile(function)).resolve().relative_to(ROOT)
    except (TypeError, ValueError):
        return None
    return place.parts[0] if place.parts[0] in kept_packages() else None


def is_keyed(package: str, signature: Any) -> bool:
    """Whether the digest covers all that the machine code for these argument types depends on."""
    covered = kept_packages()[package]
    covered_modules = tuple(f"rl_yardstick.{name}." for name in covered)
    own = all(f"{module}.".startswith(covered_modules) for module in modules_of(signature))
    return own and source_stamps(package) == stamps_at_start(package)


def modules_of(kind: Any) -> Iterator[str]:
    """The modules that define the classes and rules in argument types, or in one such type."""
    if hasattr(kind, "args"):  # a signature
        kind = kind.args
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


# Folders.


def parents(package: str) -> Iterator[Path]:
    """Folders that a package's machine code may be kept in, the best first."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        yield Path(given) / "yardstick" / package
    yield ROOT / package / "__pycache__" / "machine_code"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    yield Path(home) / "yardstick" / "machine_code" / package


@cache
def folder(package: str) -> Path | None:
    """The cache folder of a package; None where no folder is both safe and writable."""
    reason = "no folder for machine code can be written"
    for parent in parents(package):
        try:
            chosen = own_folder(parent / digest(package))
            tempfile.TemporaryFile(dir=chosen, prefix="n" * LONGEST_NAME).close()
            os.utime(chosen)
        except NotOwnError as error:
            reason = f"no folder for machine code is safe: {error}"
            continue
        except OSError:
            continue
        remove_old(chosen)
        return chosen
    warn_once(reason)
    return None


@cache
def warn_once(reason: str) -> None:
    """Warn once for each reason, whatever the number of packages."""
    logger.warning("%s: it is compiled anew in each process", reason)


class NotOwnError(OSError):
    """Another user could have written the files that would be unpickled."""


def own_folder(path: Path) -> Path:
    """Create a folder if it is missing, and check that only the user and root can write to it.

    Returns the path with links resolved; raises `NotOwnError` or another `OSError`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=0o700, exist_ok=True)
    path = path.resolve()
    _check_owner(path, path.stat(), 0o077)
    for parent in path.parents:
        status = parent.stat()
        # In a sticky folder, such as /tmp, users can remove and rename only their own files.
        is_sticky = status.st_mode & stat.S_ISVTX
        _check_owner(parent, status, 0 if is_sticky else 0o022, root_too=True)
    return path


def _check_owner(path: Path, status: os.stat_result, mask: int, root_too: bool = False) -> None:
    """Raise `NotOwnError` for another user's path, or for any permission in ``mask``."""
    if sys.platform == "win32":
        return
    owners = {os.geteuid(), 0} if root_too else {os.geteuid()}
    if status.st_uid not in owners:
        raise NotOwnError(f"{path} belongs to another user")
    if status.st_mode & mask:
        raise NotOwnError(f"{path} is open to other users, mode {stat.S_IMODE(status.st_mode):o}")


def remove_old(used: Path) -> None:
    """Remove all folders beside ``used`` except the few that were used last."""
    dated = []
    for path in used.parent.iterdir():
        try:
            dated.append((path.stat().st_mtime_ns, path))
        except OSError:
            continue  # another process has removed it
    for _, path in sorted(dated)[: -1 - KEPT_BESIDE]:
        if path != used:
            shutil.rmtree(path, ignore_errors=True)


def is_compiled_before(name: str) -> bool:
    """Whether the cache holds machine code of a function, for any argument types."""
    folders = filter(None, map(folder, kept_packages()))
    return any(any(kept_in.glob(f"*/*.{name}-*.nbi")) for kept_in in folders)


# Numba's cache classes, with our folders and conditions.


class Locator(_CacheLocator):
    """The cache folder of one function, within the folder of its package."""

    def __init__(self, function: Callable[..., object], kept_in: Path) -> None:
        file = inspect.getfile(function)
        self._path = str(kept_in / self.get_suitable_cache_subpath(file))
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Locator | None:
        package = package_of(py_func)
        kept_in = folder(package) if package else None
        return cls(py_func, kept_in) if kept_in else None

    def get_cache_path(self) -> str:
        return self._path

    def get_source_stamp(self) -> str:
        return ""  # the folder's name contains the digest of the sources

    def get_disambiguator(self) -> str:
        return str(self._line)


class Implementation(CompileResultCacheImpl):
    """Numba's cache of a compiled function, in the folder of `Locator`."""

    _locator_classes = [Locator]  # noqa: RUF012  # as Numba has it


class OwnFiles(IndexDataCacheFile):
    """The files of Numba's cache of one function, unpickled only if they belong to the user."""

    def _load_index(self) -> Any:
        self._check(Path(self._index_path))
        return super()._load_index()

    def _load_data(self, name: str) -> Any:
        self._check(Path(self._data_path(name)))
        return super()._load_data(name)

    def _check(self, path: Path) -> None:
        with contextlib.suppress(FileNotFoundError):
            _check_owner(path, path.lstat(), 0o022)
            # Its folder lies in ours, which nobody else enters.
            _check_owner(path.parent, path.parent.lstat(), 0)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        with super()._open_for_write(filepath) as file:
            Path(file.name).chmod(0o600)  # whatever the umask is
            yield file


class KeyedCache(FunctionCache):
    """Numba's cache of one function, used only where the digest covers the code."""

    _impl_class = Implementation

    def __init__(self, function: Callable[..., object], package: str) -> None:
        super().__init__(function)
        self._function, self._package = function.__qualname__, package
        self._cache_file = OwnFiles(self._cache_path, self._impl.filename_base, "")

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The machine code for these argument types, or None where it has to be compiled."""
        found = None
        if is_keyed(self._package, signature):
            try:
                found = super().load_overload(signature, target_context)
            except Exception as error:  # noqa: BLE001  # a damaged file can fail in any way
                logger.warning("the machine code of %s cannot be used: %s", self._function, error)
                with contextlib.suppress(OSError):
                    self.flush()  # the function begins with an empty index again
        if found is None:
            logger.info("compiling %s", self._function)
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        """Cache the machine code for these argument types, if the digest covers it."""
        if not is_keyed(self._package, signature):
            return
        try:
            super().save_overload(signature, data)
        except OSError as error:  # such as a full disk; this process still has the code
            logger.warning("the machine code of %s is not kept: %s", self._function, error)


class NoCache(NullCache):
    """The cache of a function that is compiled anew in each process."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function.__qualname__

    def load_overload(self, sig: Any, target_context: Any) -> None:
        logger.info("compiling %s", self._function)


def cache_of(function: Callable[..., object]) -> KeyedCache | NoCache:
    """The cache for a function's machine code."""
    package = package_of(function)
    if package is None or folder(package) is None:
        return NoCache(function)
    return KeyedCache(function, package)
