"""What the files hold that a training only appends to, and back to that."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from io import BufferedReader
from pathlib import Path

from pipeline.errors import UserError
from pipeline.file_digests import STATE_FOLDER
from pipeline.files import replacing
from safe_files.files import NO_LIMIT, UnsafeFileError, opened

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
    paths = {path.name: path for path in monitor_files(run_folder)}
    paths |= {str(path): path for path in _event_files(log_folder)}
    return {name: _position(path, path.stat().st_size) for name, path in paths.items()}


def cut_back(run_folder: Path, log_folder: str | None, positions: Mapping[str, Position]) -> None:
    """Remove what was appended since, and the files that were begun since.

    What is left is a new file, so that no other name of the old one is written to.

    Raises:
        UserError: if a file is missing, or does not begin with what it held.
    """
    for name, position in positions.items():
        path = run_folder / name  # or the name itself, where that begins at the root
        try:
            found = _position(path, position[0])
        except (FileNotFoundError, UnsafeFileError):
            found = None
        if found is None or found[:2] != tuple(position)[:2]:
            raise UserError(
                f"{path} is not as the run left it: it cannot go on from its state; remove "
                f"{run_folder / STATE_FOLDER} to begin the run again"
            )
    for path in [*monitor_files(run_folder), *_event_files(log_folder)]:
        name = path.name if path.parent == run_folder else str(path)
        if name in positions:
            with replacing(path) as draft, opened(path, NO_LIMIT) as file:
                _copy(file, positions[name][0], draft.write)
        else:
            path.unlink()


def _position(path: Path, length: int) -> Position:
    """Where a file is after so many bytes, or at its end if that comes before."""
    checksum = n_lines = 0

    def add(piece: bytes) -> None:
        nonlocal checksum, n_lines
        checksum, n_lines = zlib.crc32(piece, checksum), n_lines + piece.count(b"\n")

    with opened(path, NO_LIMIT) as file:
        return _copy(file, length, add), checksum, n_lines


def _copy(file: BufferedReader, length: int, write: Callable[[bytes], object]) -> int:
    """Hand on so many bytes of a file, or all if it has fewer; how many there were."""
    n_read = 0
    while piece := file.read(min(_PIECE, length - n_read)):
        write(piece)
        n_read += len(piece)
    return n_read


def monitor_files(run_folder: Path) -> list[Path]:
    """The files that Monitor appends to."""
    return sorted(run_folder.glob(MONITOR_FILES))


def _event_files(log_folder: str | None) -> list[Path]:
    return [] if log_folder is None else sorted(Path(log_folder).resolve().glob(EVENT_FILES))
