"""How long the files are that a training only appends to, and back to that length."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

from pipeline.errors import UserError

EVENT_FILES = "events.out.tfevents.*"


def log_positions(run_folder: Path, log_folder: str | None) -> dict[str, int]:
    """The lengths in bytes of Monitor's and TensorBoard's files.

    Args:
        run_folder: where Monitor writes.
        log_folder: where the logger does, or None.

    Returns:
        By path: of Monitor's files relative to the run folder, of the others from the root.
    """
    lengths = {path.name: path.stat().st_size for path in _monitor_files(run_folder)}
    for path in _event_files(log_folder):
        lengths[str(path)] = path.stat().st_size
    return lengths


def cut_back(run_folder: Path, log_folder: str | None, positions: Mapping[str, int]) -> None:
    """Remove what was appended since, and the files that were begun since.

    Raises:
        UserError: if a file is missing, or shorter than it was.
    """
    for name, length in positions.items():
        path = run_folder / name  # or the name itself, where that begins at the root
        if not path.is_file() or path.stat().st_size < length:
            raise UserError(f"{path} is not as the run left it: it cannot go on from its state")
    for path in [*_monitor_files(run_folder), *_event_files(log_folder)]:
        name = path.name if path.parent == run_folder else str(path)
        if name in positions:
            os.truncate(path, positions[name])
        else:
            path.unlink()


def remove_events(log_folder: str) -> None:
    """Remove TensorBoard's files of a run that begins anew, and their folder if it is empty."""
    for path in _event_files(log_folder):
        path.unlink()
    with contextlib.suppress(OSError):
        Path(log_folder).rmdir()


def _monitor_files(run_folder: Path) -> list[Path]:
    # By the numbers of the environments: a wrapper that the settings name begins its file anew.
    return sorted(run_folder.glob("[0-9]*.monitor.csv"))


def _event_files(log_folder: str | None) -> list[Path]:
    return [] if log_folder is None else sorted(Path(log_folder).resolve().glob(EVENT_FILES))
