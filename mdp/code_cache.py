"""Where machine code is kept between two processes, and when it may be used again.

Numba keeps the machine code of a function beside its source, and throws it away when that one file
changes. A function that others inline can change without that: they go on running as it was. Here
the machine code lies in a folder named for a digest of every source that can take part in it, and
of the versions of Python, Numba and NumPy. A changed source has another digest, and so never meets
old code; nor does another processor, which Numba itself keeps apart.

Not kept on disk is code that depends on sources outside of this project, such as a user's own
update rule, and whatever is compiled in a process whose sources have changed since it began. Where
no folder can be written, nothing is kept.

Numba unpickles what it finds, which can run any code. So a folder serves only if no other user but
root can put a file into it, or another folder in its place; and a file only if it is the user's.
"""

# mypy: allow-untyped-calls
# Numba's classes are not typed.

from __future__ import annotations

import contextlib
import importlib.metadata
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
from numba.core.caching import FunctionCache, IndexDataCacheFile

from mdp.source_files import content_lines, digest_of, source_paths

# Everything that is compiled, and every constant that is compiled into it, stands in these.
PACKAGES = ("mdp", "agents")

# Folders of other digests that are left, so that one can go back and forth between two versions.
KEPT_BESIDE = 3

# What Numba's names and folders for one function come to, with some to spare. Windows takes paths
# of 260 characters, and an environment deep in somebody's folders leaves too few.
LONGEST_NAME = 120

# The first field of a record of settings: after this come the algorithm's module and its class.
RULE_PREFIX = "rule "

logger = logging.getLogger("mdp.machine_code")

Stamps = tuple[tuple[str, int, int], ...]


def source_stamps() -> Stamps:
    """Path, time of change in nanoseconds and size of every source, in the order of their names."""
    paths = source_paths(PACKAGES)
    return tuple((str(path), (at := path.stat()).st_mtime_ns, at.st_size) for path in paths)


@cache
def stamps_at_start() -> Stamps:
    """The stamps when they were first asked for in this process."""
    return source_stamps()


@cache
def digest() -> str:
    """Of the sources and of what compiles them; Numba itself tells processors apart."""
    compilers = ("numba", "numpy", "llvmlite")
    lines = [f"{name} {importlib.metadata.version(name)}" for name in compilers]
    lines.append(f"python {platform.python_version()}")
    settings: Any = numba.config
    lines.append(f"optimised {settings.OPT}, bounds checked {settings.BOUNDSCHECK}")
    # Stamped before they are read: what changes from then on is noticed.
    lines += content_lines(Path(path) for path, _, _ in stamps_at_start())
    return digest_of(lines)


def parents() -> Iterator[Path]:
    """Folders that machine code may be kept in, the best first."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        yield Path(given) / "yardstick"
    yield Path(__file__).parent / "__pycache__" / "machine_code"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    yield Path(home) / "yardstick" / "machine_code"


@cache
def folder() -> Path | None:
    """Where this process keeps machine code; None where no folder is the user's, or writable."""
    reason = "no folder for machine code can be written"
    for parent in parents():
        try:
            chosen = own_folder(parent / digest())
            tempfile.TemporaryFile(dir=chosen, prefix="n" * LONGEST_NAME).close()
            os.utime(chosen)
        except NotOwnError as error:
            reason = f"no folder for machine code is safe: {error}"
            continue
        except OSError:
            continue
        remove_old(chosen.parent)
        return chosen
    logger.warning("%s: it is compiled anew in each process", reason)
    return None


class NotOwnError(OSError):
    """Another user could have written what would be unpickled."""


def own_folder(path: Path) -> Path:
    """A folder, made where it is missing, whose files only the user and root can have written.

    Returns:
        The folder, without the links on the way to it.

    Raises:
        NotOwnError: if another user could write in it, or replace a folder on the way to it.
        OSError: if it cannot be made.
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


def is_compiled_before(name: str) -> bool:
    """Whether machine code of a function of ours is kept, for whatever argument types."""
    kept_in = folder()
    return kept_in is not None and any(kept_in.glob(f"*/*.{name}-*.nbi"))


def remove_old(parent: Path) -> None:
    """Leave the folder in use and the few that were used last before it."""
    dated = []
    for path in parent.iterdir():
        try:
            dated.append((path.stat().st_mtime_ns, path))
        except OSError:
            continue  # another process has removed it
    for _, path in sorted(dated)[: -1 - KEPT_BESIDE]:
        if path.name != digest():
            shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def numba_cache_dir(path: Path) -> Iterator[None]:
    """Let functions that are decorated meanwhile keep their machine code in ``path``."""
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(path)
    try:
        yield
    finally:
        config.CACHE_DIR = before


class OwnCache(FunctionCache):
    """Numba's cache of one function, in files that only the user can have written."""

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = OwnFiles(self._cache_path, self._impl.filename_base, stamp)


class CheckedCache:
    """Numba's cache of one function, asked only where what it holds is sure to be right.

    Args:
        cache: Numba's own.
        name: of the function, for the log.
    """

    def __init__(self, cache: Any, name: str) -> None:
        self._cache = cache
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name == "_cache":
            raise AttributeError(name)  # of a copy that is being made
        return getattr(self._cache, name)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The machine code for these argument types, or None where it has to be compiled."""
        found = None
        if is_keyed(signature):
            try:
                found = self._cache.load_overload(signature, target_context)
            except Exception as error:  # noqa: BLE001  # a damaged file can fail in any way
                logger.warning("the machine code of %s cannot be used: %s", self._name, error)
                self._forget()
        if found is None:
            logger.info("compiling %s", self._name)
        return found

    def _forget(self) -> None:
        """Let the function begin with an empty index again."""
        with contextlib.suppress(OSError):
            self._cache.flush()

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep the machine code for these argument types, where the digest stands for it."""
        if not is_keyed(signature):
            return
        try:
            self._cache.save_overload(signature, data)
        except OSError as error:  # a full disk, say: the code is there, for this process
            logger.warning("the machine code of %s is not kept: %s", self._name, error)


def is_keyed(signature: Any) -> bool:
    """Whether the digest covers all that the machine code for these argument types depends on."""
    own = all(module.partition(".")[0] in PACKAGES for module in modules_of(signature))
    return own and source_stamps() == stamps_at_start()


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
