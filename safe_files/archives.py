"""Zips, of which no more is unpacked than the budget of their file allows."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from safe_files.limits import MAX_MEMBERS, Budget
from safe_files.refusals import UnsafeFileError, shown

# What begins each entry of a zip's list of members, and what Python makes of one.
_ENTRY, _BYTES_PER_ENTRY = b"PK\1\2", 1000
# The library stores members as they are. Whoever packs a zip anew may deflate them.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

# What the library raises at zips that are damaged, encrypted, or of a kind that it does not know.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    ValueError,
    EOFError,
    NotImplementedError,
    RuntimeError,
)


def read_members(
    content: bytes, expected: frozenset[str] | None = None, budget: Budget | None = None
) -> dict[str, bytes]:
    """The members of a zip, by their names.

    Args:
        content: the zip.
        expected: the names that members may have; None for any.
        budget: pays for the members; None for that of such a file.

    Raises:
        UnsafeFileError: if it is no whole zip, unpacks to too much, or has other members.
    """
    budget = budget or Budget(len(content))
    with opened_zip(content, budget) as archive:
        infos = archive.infolist()
        names = [info.filename for info in infos]
        strange = [] if expected is None else sorted(set(names) - expected)
        if strange:
            raise UnsafeFileError(f"holds {shown(strange[0])}, which no model file has")
        if len(names) > MAX_MEMBERS:
            raise UnsafeFileError(f"holds more than {MAX_MEMBERS} members")
        budget.charge(sum(info.file_size for info in infos))
        # A member that unpacks to more than it says fails its own check.
        return {name: archive.read(name) for name in names}


@contextmanager
def opened_zip(content: bytes, budget: Budget) -> Iterator[zipfile.ZipFile]:
    """A zip in which no member stands twice.

    Raises:
        UnsafeFileError: if it is none, or is damaged where it is read meanwhile.
    """
    budget.charge(content.count(_ENTRY) * _BYTES_PER_ENTRY)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            if len({info.filename for info in infos}) != len(infos):
                raise UnsafeFileError("holds a member twice")
            if any(info.compress_type not in _METHODS for info in infos):
                raise UnsafeFileError("has a compression method that is not read here")
            yield archive
    except UnsafeFileError:
        raise
    except _DAMAGE as error:
        raise UnsafeFileError(f"is no whole zip: {error}") from error
