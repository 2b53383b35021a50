"""Opens files of unknown origin safely, and limits their sizes.

A folder of runs may come from a stranger, and any name in it may be a link, a pipe or a device.
Once the folder is held, each path below it is opened step by step from the folder itself, and no
step may be a link. A link on the way to the folder is the user's own, and is followed.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NO_LIMIT = 1 << 62  # bytes
# A model of a hundred million parameters is larger than any that these algorithms train.
MAX_ARCHIVE_BYTES = 1 << 30
MAX_STATISTICS_BYTES = 64 << 20
MAX_BUFFER_BYTES = 32 << 30
# Reading a file may take this multiple of its size, plus these bytes.
_TIMES = 4
_FREE_BYTES = 64 << 20
# An empty dictionary and its slot in a container: no value takes more in addition to its text.
_BYTES_PER_JSON_VALUE = 100
# If the system does not report its memory.
_MEMORY_IF_UNKNOWN = 16 << 30


class UnsafeFileError(ValueError):
    """A file has forbidden contents, is damaged, or is too large; the message is one line.

    Attributes:
        key: the faulty entry of a model file, or None.
    """

    def __init__(self, message: str, key: str | None = None) -> None:
        # Control characters are escaped.
        signs = (c if c.isprintable() else repr(c)[1:-1] for c in " ".join(message.split()))
        super().__init__("".join(signs))
        self.key = key


def shown(value: object) -> str:
    """Quote a name from a file for a message: shortened, with control characters escaped."""
    text = ascii(value)
    return text if len(text) <= 80 else f"{text[:76]}...'"


class Budget:
    """The memory that reading a file may take; charged before each allocation."""

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes
        self.left = _FREE_BYTES + _TIMES * n_bytes

    def charge(self, n_bytes: int) -> None:
        """Charge ``n_bytes``; raises UnsafeFileError if fewer are left."""
        self.left -= n_bytes
        if self.left < 0:
            raise UnsafeFileError(
                f"would take more memory than {_TIMES} times its {self.n_bytes:,} bytes and "
                f"{_FREE_BYTES >> 20} MB"
            )

    def charge_json(self, text: bytes) -> None:
        """Charge the memory of parsing a JSON text; see `charge`."""
        # One non-ASCII character can make all others of a text four bytes wide.
        self.charge(len(text) * (2 if text.isascii() else 8))
        self.charge(sum(map(text.count, (b"[", b"{", b",", b":"))) * _BYTES_PER_JSON_VALUE)


def memory_bytes() -> int:
    """The memory of this machine in bytes."""
    size = _MEMORY_IF_UNKNOWN
    if sys.platform != "win32":
        with contextlib.suppress(ValueError, OSError):
            size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return size


# --- opening --------------------------------------------------------------------------------------

# A file to read: a path, or a stream of bytes that were read already.
Source = Path | str | io.BufferedIOBase

# Each is 0 if the system lacks it. With NONBLOCK, opening a pipe does not wait for its other end.
_BYTES = getattr(os, "O_BINARY", 0)
_ALWAYS = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | _BYTES
NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BYTES  # fails if the name exists, even as a link
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_STEP = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)
_LINKS = {errno.ELOOP: "it is a link", errno.ENOTDIR: "it lies behind a link, or no folder"}
_HAS_STEPS = bool(_NO_LINK) and os.open in os.supports_dir_fd
_JUNCTION = getattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", -1)

_held: set[str] = set()


def hold(folder: Path) -> None:
    """From now on, follow no link inside this folder in this process."""
    _held.add(_whole(folder))


def take_up(folder: Path) -> None:
    """Hold a folder that contains only files and folders, so that libraries may open its paths."""
    hold(folder)
    pending = [str(folder)]
    while pending:
        try:
            with os.scandir(pending.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        pending.append(entry.path)
                    elif not entry.is_file(follow_symlinks=False) and os.path.lexists(entry.path):
                        raise UnsafeFileError(
                            f"{entry.path} is a link, a pipe or a device: only files and folders "
                            "may lie there"
                        )
        except FileNotFoundError:  # another process works there
            continue


@contextmanager
def folder_of(path: Path) -> Iterator[tuple[Path, int | None]]:
    """The folder of a path for functions of `os`: a prefix for names, and ``dir_fd``.

    Raises OSError if the folder is missing, or lies behind a link in a held folder.
    """
    whole = _whole(path)
    held = _held_above(whole)
    if not _HAS_STEPS:
        _check_steps(Path(whole).parent, held)
        if not path.parent.is_dir():
            raise OSError(errno.ENOENT, "its folder is gone", str(path))
        yield path.parent, None
        return
    folder = _opened(held or str(Path(whole).parent), _STEP, None, path)
    try:
        for name in () if held is None else Path(whole[len(held) + 1 :]).parts[:-1]:
            inner = _opened(name, _STEP | _NO_LINK, folder, path)
            os.close(folder)
            folder = inner
        yield Path(), folder
    finally:
        os.close(folder)


def open_number(path: Path, flags: int) -> int:
    """Open a file of any kind without waiting, and return its descriptor."""
    held = _held_above(_whole(path))
    if held is None:  # the user's own place
        return os.open(path, flags | _ALWAYS)
    with folder_of(path) as (before, folder):
        if folder is None:
            _check_steps(path, held)
        return _opened(str(before / path.name), flags | _ALWAYS | _NO_LINK, folder, path)


@contextmanager
def opened(path: Path, limit: int) -> Iterator[io.BufferedReader]:
    """Open a regular file of at most ``limit`` bytes; checks the file that it has opened.

    Refuses pipes and devices, which could be endless, and files behind a link in a held
    folder.
    """
    try:
        # For a folder, Python raises the error itself, and closes the folder.
        file = open(  # noqa: SIM115  # what it raises is told apart from what its user raises
            path, "rb", opener=lambda _path, _flags: open_number(path, os.O_RDONLY)
        )
    except IsADirectoryError:
        raise UnsafeFileError(f"{path} is no regular file") from None
    except OSError as error:
        if error.strerror in _LINKS.values():
            raise UnsafeFileError(f"{path} is no regular file: {error.strerror}") from error
        raise
    with file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise UnsafeFileError(f"{path} is no regular file")
        if status.st_size > limit:
            raise UnsafeFileError(f"{path} is larger than {limit:,} bytes")
        yield file


def read_file(path: Path, limit: int) -> bytes:
    """Read a whole regular file; see `opened`."""
    with opened(path, limit) as file:
        # The file may grow meanwhile: read no more than its first size.
        return file.read(os.fstat(file.fileno()).st_size)


def content_of(source: Source, limit: int) -> bytes:
    """Read a whole regular file or stream of at most ``limit`` bytes."""
    if not isinstance(source, io.BufferedIOBase):
        return read_file(Path(source), limit)
    content = source.read(limit + 1)
    if len(content) > limit:
        raise UnsafeFileError(f"is larger than {limit:,} bytes")
    return content


def _held_above(path: str) -> str | None:
    """The outermost held folder that contains a path."""
    end = path.find(os.sep, 1) if _held else -1
    while end > 0 and path[:end] not in _held:
        end = path.find(os.sep, end + 1)
    return path[:end] if end > 0 else None


def _whole(path: Path) -> str:
    """The absolute path, without following links."""
    return os.path.normpath(path.absolute())


def _opened(name: str, flags: int, folder: int | None, path: Path) -> int:
    try:
        return os.open(name, flags, dir_fd=folder)
    except OSError as error:
        reason = _LINKS.get(error.errno or 0) if flags & _NO_LINK else None
        if error.errno == errno.ENOENT and flags & _STEP:
            reason = "its folder is gone"
        raise OSError(error.errno, reason or error.strerror, str(path)) from error


def _check_steps(path: Path, held: str | None) -> None:
    """Refuse links between a held folder and a path, if opening cannot refuse them."""
    for step in () if held is None else (path.absolute(), *path.absolute().parents):
        if str(step) == held:
            return
        if os.path.lexists(step):
            status = os.lstat(step)
            if stat.S_ISLNK(status.st_mode) or getattr(status, "st_reparse_tag", 0) == _JUNCTION:
                raise OSError(errno.ELOOP, _LINKS[errno.ELOOP], str(path))
