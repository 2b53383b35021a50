"""Files read once, whole, and only where they are files of a bearable size."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from safe_files.refusals import UnsafeFileError


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


def _check(status: os.stat_result, path: Path, limit: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise UnsafeFileError(f"{path} is no regular file")
    if status.st_size > limit:
        raise UnsafeFileError(f"{path} is larger than {limit:,} bytes")
