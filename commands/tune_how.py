"""How a tuning is done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from commands.places import Place


@dataclass(frozen=True)
class How:
    """How a tuning is done.

    Attributes:
        place: of a folder, where its runs are done.
        command: the command that asked for it.
        deadline: when the search begins no further run, by `time.monotonic`.
        with_page: draw figures and write pages.
    """

    place: Callable[[Path], Place]
    command: str
    deadline: float
    with_page: bool
