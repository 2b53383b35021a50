"""The folder in a run's in which its states lie: the newest two, so that one is whole."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

GENERATIONS = 2


def state_file(folder: Path, number: int) -> Path:
    """Where the state of that number lies, in place of the one before the last."""
    return folder / f"{'odd' if number % GENERATIONS else 'even'}.state"


def state_files(folder: Path) -> list[Path]:
    """Where states may lie."""
    return [state_file(folder, number) for number in range(GENERATIONS)]


def has_state(folder: Path) -> bool:
    """Whether there is a file that may be a state."""
    return any(path.is_file() for path in state_files(folder))


def remove_states(folder: Path) -> None:
    """Remove all states."""
    shutil.rmtree(folder, ignore_errors=True)


def settings_digest(spec: Mapping[str, Any]) -> str:
    """What tells a run's settings from others'."""
    text = json.dumps(spec, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
