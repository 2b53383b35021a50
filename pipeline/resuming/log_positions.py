"""What the files hold that a training only appends to, and back to that."""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Mapping
from pathlib import Path

from pipeline.errors import UserError
from pipeline.file_digests import STATE_FOLDER

EVENT_FILES = "events.out.tfevents.*"
# By the numbers of the environments: a wrapper that the settings name begins its file anew.
MONITOR_FILES = "[0-9]*.monitor.csv"
_PIECE = 1 << 20  # bytes

# A file's length in bytes, the checksum of them, and the lines that they are.
Position = tuple[int, int, int]


def log_positions(run_folder: Path, log_folder: str | None) -> dict[str, Position]:
    """How far Monitor's and TensorBoard's files have come.

    Args:
        run_folder: where Monitor writes.
        log_folder: where the logger does, or None.

    Returns:
        By path: of Monitor's files relative to the run folder, of the others from the root.
    """
    paths = {path.name: path for path in _monitor_files(run_folder)}
    paths |= {str(path): path for path in _event_files(log_folder)}
    return {name: _position(path, path.stat().st_size) for name, path in paths.items()}


def cut_back(run_folder: Path, log_folder: str | None, positions: Mapping[str, Position]) -> None:
    """Remove what was appended since, and the files that were begun since.

    Raises:
        UserError: if a file is missing, or does not begin with what it held.
    """
    for name, position in positions.items():
        path = run_folder / name  # or the name itself, where that begins at the root
        if not path.is_file() or _position(path, position[0])[:2] != tuple(position)[:2]:
            raise UserError(
                f"{path} is not as the run left it: it cannot go on from its state; remove "
                f"{run_folder / STATE_FOLDER} to begin the run again"
            )
    for path in [*_monitor_files(run_folder), *_event_files(log_folder)]:
        name = path.name if path.parent == run_folder else str(path)
        if name in positions:
            os.truncate(path, positions[name][0])
        else:
            path.unlink()


def remove_events(log_folder: str) -> None:
    """Remove TensorBoard's files of a run that begins anew, and their folder if it is empty."""
    for path in _event_files(log_folder):
        path.unlink()
    with contextlib.suppress(OSError):
        Path(log_folder).rmdir()


def _position(path: Path, length: int) -> Position:
    """Where a file is after so many bytes, or at its end if that comes before."""
    n_read = checksum = n_lines = 0
    with path.open("rb") as file:
        while piece := file.read(min(_PIECE, length - n_read)):
            n_read, checksum = n_read + len(piece), zlib.crc32(piece, checksum)
            n_lines += piece.count(b"\n")
    return n_read, checksum, n_lines


def _monitor_files(run_folder: Path) -> list[Path]:
    return sorted(run_folder.glob(MONITOR_FILES))


def _event_files(log_folder: str | None) -> list[Path]:
    return [] if log_folder is None else sorted(Path(log_folder).resolve().glob(EVENT_FILES))
