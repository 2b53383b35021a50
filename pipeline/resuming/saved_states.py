"""States of a run that is under way: written, and read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.files import replacing, sync_folders
from pipeline.resuming.state_folder import state_file, state_files
from pipeline.source_digest import source_digest
from safe_files.files import NO_LIMIT, UnsafeFileError, opened
from snapshots.recording import Snapshot
from snapshots.snapshot_files import BadSnapshotError, read_snapshot, write_snapshot
from snapshots.user_key import user_key

APPLICATION = "yardstick"
SOURCES = "sources"


@dataclass(frozen=True)
class SavedState:
    """A state that was read back.

    Attributes:
        snapshot: of the training.
        note: what else was written down.
    """

    snapshot: Snapshot
    note: dict[str, Any]

    @property
    def is_of_these_sources(self) -> bool:
        """Whether what goes on from it does what the training did that saved it."""
        return self.note.get(SOURCES) == source_digest()


def state_key() -> bytes:
    """The key under which this user's states are written.

    Raises:
        UserError: if there is none and none can be made.
    """
    try:
        return user_key(APPLICATION)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or error
        raise UserError(f"the key to saved states: {place}{reason}") from error


def save_state(folder: Path, number: int, snapshot: Snapshot, note: dict[str, Any]) -> None:
    """Write the state of that number in place of the one before the last.

    Raises:
        OSError: if it cannot be written; the last one is there still.
        UserError: if there is no key to write it under.
    """
    key = state_key()
    folder.mkdir(exist_ok=True)
    with replacing(state_file(folder, number)) as file:
        whole_note = {**note, "number": number, SOURCES: source_digest()}
        write_snapshot(file, snapshot, whole_note, key)
    sync_folders(folder)


def newest_state(folder: Path, tell: Callable[[str], object]) -> SavedState | None:
    """The newest state that is whole, or None where there is none at all.

    Args:
        folder: the states'.
        tell: told of one that is not.

    Raises:
        UserError: if there are some, and none is whole or this user's.
    """
    key, found, reasons = state_key(), [], []
    for path in filter(Path.is_file, state_files(folder)):
        try:
            with opened(path, NO_LIMIT) as file:
                found.append(SavedState(*read_snapshot(file, key)))
        except FileNotFoundError:
            continue
        except (OSError, UnsafeFileError, BadSnapshotError, MemoryError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            reasons.append(f"{path}: {str(reason).removeprefix(f'{path} ')}")
    if reasons and not found:
        raise UserError(f"{reasons[0]}; remove {folder} to begin the run again")
    for reason in reasons:
        tell(f"{reason}; the state before it is taken")
    return max(found, key=lambda state: int(state.note["number"]), default=None)
