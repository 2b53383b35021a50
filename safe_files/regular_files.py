"""Files read once, whole, and only where they are files of a bearable size."""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from safe_files.refusals import UnsafeFileError

# What is read: a path, or a stream of bytes that were read already.
Source = Path | str | io.BufferedIOBase


@contextmanager
def opened(path: Path, limit: int) -> Iterator[BinaryIO]:
    """A regular file, open for reading: what is checked is what is used.

    Args:
        path: the file.
        limit: the most bytes that it may have.

    Raises:
        UnsafeFileError: if it is no regular file (a pipe or a device could go on for ever), or
            larger than that.
        OSError: if it cannot be read.
    """
    # Looked at first, since to open a pipe may already wait for ever; and again once it is open,
    # since another may lie there by then.
    _check(path.stat(), path, limit)
    with path.open("rb") as file:
        _check(os.fstat(file.fileno()), path, limit)
        yield file


def read_file(path: Path, limit: int) -> bytes:
    """All of a regular file; see `opened`."""
    with opened(path, limit) as file:
        # It may grow meanwhile: what is read is no more than was there.
        return file.read(os.fstat(file.fileno()).st_size)


def content_of(source: Source, limit: int) -> bytes:
    """All of a regular file, or of a stream.

    Raises:
        UnsafeFileError: if it is larger than ``limit``, or the file is no regular one.
        OSError: if it cannot be read.
    """
    if not isinstance(source, io.BufferedIOBase):
        return read_file(Path(source), limit)
    content = source.read(limit + 1)
    if len(content) > limit:
        raise UnsafeFileError(f"is larger than {limit:,} bytes")
    return content


def _check(status: os.stat_result, path: Path, limit: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise UnsafeFileError(f"{path} is no regular file")
    if status.st_size > limit:
        raise UnsafeFileError(f"{path} is larger than {limit:,} bytes")
