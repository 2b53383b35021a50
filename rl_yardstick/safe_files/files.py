"""Opens files and zips of unknown origin, within a budget of memory; imports no libraries."""

from __future__ import annotations

import io
import json
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NO_LIMIT = 1 << 62  # bytes
MAX_ARCHIVE_BYTES = 1 << 30  # a model of a hundred million parameters and more
# Reading a file may take this multiple of its size, plus these bytes.
_TIMES, _FREE_BYTES = 5, 64 << 20
_BYTES_PER_JSON_VALUE = 100  # an empty dictionary and its slot in a container, besides the text

Source = Path | str | io.BufferedIOBase  # a file to read, or a stream of its bytes


class UnsafeFileError(ValueError):
    """A file is forbidden, damaged or too large; ``key`` is a model's faulty entry, or None."""

    def __init__(self, message: str, key: str | None = None) -> None:
        line = " ".join(message.split())
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in line))
        self.key = key


@contextmanager
def refused_as(what: str) -> Iterator[None]:
    """Any error in the block becomes an `UnsafeFileError`: ``what``, and its message."""
    try:
        yield
    except UnsafeFileError:
        raise
    except Exception as error:  # damaged files can fail anywhere
        raise UnsafeFileError(f"{what}: {str(error) or type(error).__name__}") from error


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


def opened(path: Path, limit: int) -> io.BufferedReader:
    """Open a regular file of at most ``limit`` bytes; pipes and devices could be endless."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise UnsafeFileError(f"{path} is no regular file")
    if status.st_size > limit:
        raise UnsafeFileError(f"{path} is larger than {limit:,} bytes")
    return path.open("rb")


def content_of(source: Source, limit: int) -> bytes:
    """Read a whole regular file or stream of at most ``limit`` bytes."""
    if not isinstance(source, io.BufferedIOBase):
        with opened(Path(source), limit) as file:
            content = file.read()
        if content.startswith(b"version https://git-lfs"):
            raise UnsafeFileError(f"{source} is a Git LFS pointer, not the file: run git lfs pull")
        return content
    content = source.read(limit + 1)
    if len(content) > limit:
        raise UnsafeFileError(f"is larger than {limit:,} bytes")
    return content


# --- zips of models -------------------------------------------------------------------------------

SETTINGS = "data"
_TEXTS = frozenset({SETTINGS, "_stable_baselines3_version", "system_info.txt"})
TENSORS = ".pth"  # the ending of files of tensors

# The signature of each entry in a zip's directory, and the bytes of Python's object for it.
_ENTRY, _BYTES_PER_ENTRY = b"PK\1\2", 1000
# The library stores members uncompressed. A repacked zip may deflate them; then the budget is
# charged twice the unpacked size, because Python joins the pieces.
_COPIES = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 2}


def read_members(content: bytes, budget: Budget | None = None) -> dict[str, bytes]:
    """Read the members of a zip, stored or deflated, by name, within the budget."""
    budget = budget or Budget(len(content))
    budget.charge(content.count(_ENTRY) * _BYTES_PER_ENTRY)
    members = {}
    with refused_as("is no whole zip"), zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
        if any(info.compress_type not in _COPIES for info in infos):
            raise UnsafeFileError("has a compression method that is not read here")
        budget.charge(sum(info.file_size * _COPIES[info.compress_type] for info in infos))
        for info in infos:
            with archive.open(info) as member:  # may hold more than it declares
                members[info.filename] = member.read(info.file_size)
            if len(members[info.filename]) != info.file_size:
                raise UnsafeFileError(f"{shown(info.filename)} is cut off")
    return members


def read_model(content: bytes) -> tuple[dict[str, bytes], dict[str, Any], Budget]:
    """Read a model's zip, without the libraries; refuses members that no model has.

    Returns:
        the members by name, the settings among them, in which pickles stay text, and the budget
        that is left.
    """
    budget = Budget(len(content))
    members = read_members(content, budget)
    for name in members:
        if name not in _TEXTS and not name.endswith(TENSORS):
            raise UnsafeFileError(f"holds {shown(name)}, which no model file has")
    if SETTINGS not in members or not any(name.endswith(TENSORS) for name in members):
        raise UnsafeFileError("lacks parts that a model has")
    budget.charge_json(members[SETTINGS])
    with refused_as("has settings that are no JSON"):
        data = json.loads(members[SETTINGS].decode())
    if not isinstance(data, dict):
        raise UnsafeFileError("has settings that do not map names to values")
    return members, data, budget
