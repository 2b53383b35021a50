"""Signs of life, by the clock of their folder: all machines that share it agree on that one."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from pathlib import Path

from safe_files.files import NO_LIMIT, UnsafeFileError, opened

SECONDS_BETWEEN_SIGNS = 5.0

# What is written beside its place for an instant, here and by `pipeline.files.replacing`.
_FOR_AN_INSTANT = re.compile(r"\..*[0-9a-f]{16}(\.dead)?\.tmp")
_SECONDS_OF_AN_INSTANT = 5.0


def give_sign(path: Path) -> None:
    """Show that the owner of a file or folder is alive."""
    # Without a time, so that a network folder takes that of its server.
    os.utime(path, follow_symlinks=os.utime not in os.supports_follow_symlinks)


def seconds_silent(path: Path) -> float:
    """How long ago `give_sign` was last called for a path, or it was written to.

    Raises:
        OSError: if there is no such path, or its folder cannot be written to.
    """
    return _now_in(path.parent) - last_sign(path)


def last_sign(path: Path) -> float:
    """When that was, by the folder's clock.

    Raises:
        OSError: if there is no such path.
        UnsafeFileError: if it is neither a regular file nor a folder.
    """
    if path.is_dir():
        return path.stat().st_mtime
    # Network folders remember for a while what a file was, but not beyond its being opened.
    with opened(path, NO_LIMIT) as file:
        return os.fstat(file.fileno()).st_mtime


def _now_in(folder: Path) -> float:
    probe = folder / f".{secrets.token_hex(8)}.tmp"
    try:
        probe.touch()
        return probe.stat().st_mtime
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()


def remove_remains(root: Path) -> None:
    """Remove what processes that were killed have left half written, in a folder or one below."""
    for folder in (root, *(root / name for name in _names_in(root))):
        for name in filter(_FOR_AN_INSTANT.fullmatch, _names_in(folder)):
            path = folder / name
            with contextlib.suppress(OSError, UnsafeFileError):
                if seconds_silent(path) > _SECONDS_OF_AN_INSTANT:
                    if path.is_dir():
                        path.rmdir()
                    else:
                        path.unlink()


def _names_in(folder: Path) -> list[str]:
    """What lies in a folder; nothing where it is none, or has gone meanwhile, as others' do."""
    with contextlib.suppress(OSError):
        return [path.name for path in folder.iterdir()]
    return []
