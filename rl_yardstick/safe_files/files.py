"""Opens files of unknown origin, and limits the memory that reading them may take."""

from __future__ import annotations

import io
import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

NO_LIMIT = 1 << 62  # bytes
# A model of a hundred million parameters is larger than any that these algorithms train.
MAX_ARCHIVE_BYTES = 1 << 30
# Reading a file may take this multiple of its size, plus these bytes.
_TIMES, _FREE_BYTES = 5, 64 << 20
# An empty dictionary and its slot in a container: no value takes more in addition to its text.
_BYTES_PER_JSON_VALUE = 100

# A file to read: a path, or a stream of bytes that were read already.
Source = Path | str | io.BufferedIOBase


class UnsafeFileError(ValueError):
    """A file is forbidden, damaged or too large; ``key`` is a model's faulty entry, or None."""

    def __init__(self, message: str, key: str | None = None) -> None:
        line = " ".join(message.split())
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in line))
        self.key = key


def shown(value: object) -> str:
    """Quote a name from a file for a message: shortened, with control characters escaped."""
    text = ascii(value)
    return text if len(text) <= 80 else f"{text[:76]}...'"


class Budget:
    """The memory that reading a file may take; charged before each allocation."""

    def __init__(self, n_bytes: int) -> None:
        self.left = _FREE_BYTES + _TIMES * n_bytes

    def charge(self, n_bytes: int) -> None:
        """Charge ``n_bytes``; raises UnsafeFileError if fewer are left."""
        self.left -= n_bytes
        if self.left < 0:
            most = f"{_TIMES} times its size and {_FREE_BYTES >> 20} MB"
            raise UnsafeFileError(f"would take more memory than {most}")

    def charge_json(self, text: bytes) -> None:
        """Charge the memory of parsing a JSON text; see `charge`."""
        # One non-ASCII character can make all others of a text four bytes wide.
        self.charge(len(text) * (2 if text.isascii() else 8))
        self.charge(sum(map(text.count, (b"[", b"{", b",", b":"))) * _BYTES_PER_JSON_VALUE)


def memory_bytes() -> int:
    """The memory of this machine in bytes; 16 GB if the system does not report it."""
    if sys.platform != "win32":
        with suppress(ValueError, OSError):
            return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return 16 << 30


def opened(path: Path, limit: int) -> io.BufferedReader:
    """Open a regular file of at most ``limit`` bytes; pipes and devices could be endless."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise UnsafeFileError(f"{path} is no regular file")
    if status.st_size > limit:
        raise UnsafeFileError(f"{path} is larger than {limit:,} bytes")
    return path.open("rb")


def read_file(path: Path, limit: int) -> bytes:
    """Read a whole regular file of at most ``limit`` bytes."""
    with opened(path, limit) as file:
        return file.read()


def content_of(source: Source, limit: int) -> bytes:
    """Read a whole regular file or stream of at most ``limit`` bytes."""
    if not isinstance(source, io.BufferedIOBase):
        return read_file(Path(source), limit)
    content = source.read(limit + 1)
    if len(content) > limit:
        raise UnsafeFileError(f"is larger than {limit:,} bytes")
    return content
