"""Where machine code is kept between two processes, and when it may be used again.

Numba keeps the machine code of a function beside its source, and throws it away when that one file
changes. A function that others inline can change without that: they go on running as it was. Here
the machine code of a package lies in a folder named for a digest of every source that can take
part in it, and of the versions of Python, Numba and NumPy. A changed source has another digest, and
so never meets old code; nor does another processor, which Numba itself keeps apart.

Not kept on disk is code that depends on other sources, such as a user's own update rule, and
whatever is compiled in a process whose sources have changed since it began. Where no folder can be
written, nothing is kept.

Numba unpickles what it finds, which can run any code. So a folder serves only if no other user but
root can put a file into it, or another folder in its place; and a file only if it is the user's.
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

from machine_code.sources import ROOT, content_lines, digest_of, kept_packages, source_paths

# Folders of other digests that are left, so that one can go back and forth between two versions.
KEPT_BESIDE = 3

# What Numba's names and folders for one function come to, with some to spare. Windows takes paths
# of 260 characters, and an environment deep in somebody's folders leaves too few.
LONGEST_NAME = 120

# The first field of a record of settings: after this come the algorithm's module and its class.
RULE_PREFIX = "rule "

logger = logging.getLogger("machine_code")

Stamps = tuple[tuple[str, int, int], ...]


# What machine code is keyed by.


def source_stamps(package: str) -> Stamps:
    """Path, time of change in nanoseconds and size of every source, in the order of their names."""
    paths = source_paths(kept_packages()[package])
    return tuple((str(path), (at := path.stat()).st_mtime_ns, at.st_size) for path in paths)


@cache
def stamps_at_start(package: str) -> Stamps:
    """The stamps when they were first asked for in this process."""
    return source_stamps(package)


@cache
def digest(package: str) -> str:
    """Of a package's sources and of what compiles them; Numba itself tells processors apart."""
    compilers = ("numba", "numpy", "llvmlite")
    lines = [f"{name} {importlib.metadata.version(name)}" for name in compilers]
    lines.append(f"python {platform.python_version()}")
    settings: Any = numba.config
    lines.append(f"optimised {settings.OPT}, bounds checked {settings.BOUNDSCHECK}")
    # Stamped before they are read: what changes from then on is noticed.
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
    own = all(module.partition(".")[0] in covered for module in modules_of(signature))
    return own and source_stamps(package) == stamps_at_start(package)


def modules_of(kind: Any) -> Iterator[str]:
    """Where the classes and rules live that argument types, or one such type, are made of."""
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
    """Where this process keeps machine code; None where no folder is the user's, or writable."""
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
    """Of several packages, one line is enough."""
    logger.warning("%s: it is compiled anew in each process", reason)


class NotOwnError(OSError):
    """Another user could have written what would be unpickled."""


def own_folder(path: Path) -> Path:
    """A folder, made where it is missing, whose files only the user and root can have written.

    Returned without the links on the way to it; else a `NotOwnError` or another `OSError`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=0o700, exist_ok=True)
    path = path.resolve()
    _check_owner(path, path.stat(), 0o077)
    for parent in path.parents:
        status = parent.stat()
        # Of a folder such as /tmp, everybody can take away what is their own alone.
        is_sticky = status.st_mode & stat.S_ISVTX
        _check_owner(parent, status, 0 if is_sticky else 0o022, root_too=True)
    return path


def _check_owner(path: Path, status: os.stat_result, mask: int, root_too: bool = False) -> None:
    """Refuse what belongs to another user, or that the users in the mask have a right to."""
    if sys.platform == "win32":
        return
    owners = {os.geteuid(), 0} if root_too else {os.geteuid()}
    if status.st_uid not in owners:
        raise NotOwnError(f"{path} belongs to another user")
    if status.st_mode & mask:
        raise NotOwnError(f"{path} is open to other users, mode {stat.S_IMODE(status.st_mode):o}")


def remove_old(used: Path) -> None:
    """Leave the folder in use, and of those beside it the few that were used last."""
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
    """Whether machine code of a function of ours is kept, for whatever argument types."""
    folders = filter(None, map(folder, kept_packages()))
    return any(any(kept_in.glob(f"*/*.{name}-*.nbi")) for kept_in in folders)


# Numba's cache, told where and when.


class Locator(_CacheLocator):
    """The place of one function in the folder of its package."""

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
        return ""  # the folder's name has it

    def get_disambiguator(self) -> str:
        return str(self._line)


class Implementation(CompileResultCacheImpl):
    """What Numba keeps of a compiled function, in the place that `Locator` gives."""

    _locator_classes = [Locator]  # noqa: RUF012  # as Numba has it


class OwnFiles(IndexDataCacheFile):
    """The files of Numba's cache of one function: unpickled only if they are the user's."""

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
    """Numba's cache of one function, asked only where what it holds is sure to be right."""

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
        """Keep the machine code for these argument types, where the digest stands for it."""
        if not is_keyed(self._package, signature):
            return
        try:
            super().save_overload(signature, data)
        except OSError as error:  # a full disk, say: the code is there, for this process
            logger.warning("the machine code of %s is not kept: %s", self._function, error)


class NoCache(NullCache):
    """Of one function that is compiled anew in each process."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function.__qualname__

    def load_overload(self, sig: Any, target_context: Any) -> None:
        logger.info("compiling %s", self._function)


def cache_of(function: Callable[..., object]) -> KeyedCache | NoCache:
    """Where a function's machine code is kept."""
    package = package_of(function)
    if package is None or folder(package) is None:
        return NoCache(function)
    return KeyedCache(function, package)
