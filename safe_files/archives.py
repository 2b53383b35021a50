"""Zips held against their limits before anything of them is unpacked."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping

from safe_files.limits import MAX_ARCHIVE_BYTES, MAX_MEMBERS, MAX_TENSOR_RECORDS
from safe_files.refusals import UnsafeFileError, shown

# The library stores members as they are. Whoever packs a zip anew may deflate them, and weights
# become a little smaller; what becomes much smaller is a bomb, unless it is small.
FREELY_UNPACKED = 64 << 20
MOST_TIMES = 20

# What the library raises at zips that are damaged, encrypted, or of a kind that it does not know.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    ValueError,
    EOFError,
    OverflowError,
    NotImplementedError,
    RuntimeError,
)


def read_members(content: bytes, expected: frozenset[str] | None = None) -> Mapping[str, bytes]:
    """The members of a zip, by their names.

    Args:
        content: the zip.
        expected: the names that members may have; None for any.

    Raises:
        UnsafeFileError: if it is no whole zip, unpacks to too much, or has other members.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            names = [info.filename for info in infos]
            strange = [] if expected is None else sorted(set(names) - expected)
            if strange:
                raise UnsafeFileError(f"holds {shown(strange[0])}, which no model file has")
            if len(names) != len(set(names)) or len(names) > MAX_MEMBERS:
                raise UnsafeFileError("holds a member twice")
            _check_sizes(infos)
            unpacked = sum(info.file_size for info in infos)
            if unpacked > max(FREELY_UNPACKED, MOST_TIMES * len(content)):
                raise UnsafeFileError(
                    f"unpacks to {unpacked:,} bytes, out of proportion to its {len(content):,}"
                )
            # A member that unpacks to more than it says fails its own check.
            return {name: archive.read(name) for name in names}
    except UnsafeFileError:
        raise
    except _DAMAGE as error:
        raise UnsafeFileError(f"is no whole zip: {error}") from error


def check_tensors(content: bytes) -> None:
    """Hold a file of tensors against its limits: PyTorch would inflate whatever it holds.

    Raises:
        UnsafeFileError: if it unpacks to too much.
    """
    try:
        if not zipfile.is_zipfile(io.BytesIO(content)):
            return
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
    except _DAMAGE as error:
        raise UnsafeFileError(f"holds tensors that are no whole zip: {error}") from error
    if len(infos) > MAX_TENSOR_RECORDS:
        raise UnsafeFileError(f"holds more than {MAX_TENSOR_RECORDS:,} tensors")
    # PyTorch stores its records as they are; one that was deflated is a bomb.
    if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
        raise UnsafeFileError("holds compressed tensors, which PyTorch does not write")
    _check_sizes(infos)


def _check_sizes(infos: list[zipfile.ZipInfo]) -> None:
    size = sum(info.file_size for info in infos)
    if size > MAX_ARCHIVE_BYTES:
        raise UnsafeFileError(f"unpacks to {size:,} bytes, more than {MAX_ARCHIVE_BYTES:,}")
