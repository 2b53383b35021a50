"""The folder of a run of a study while it is a draft, which nobody takes for a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.files import sync_together, write_text
from pipeline.json_text import json_text
from pipeline.run_folder import Run


class DraftRun(Run):
    """A run folder of which the disk need not have anything before `settle`, or its first state.

    What a power cut leaves of it without a state is begun anew.
    """

    def _write_info(self, info: dict[str, Any]) -> None:
        write_text(self.info_path, json_text(info, indent=2) + "\n")

    def _settle(self, files: Sequence[Path]) -> None:
        """Nothing: `settle` does it, for ``run.json`` too."""


def settle(draft: Path) -> None:
    """Wait until the disk has a draft, which is about to be renamed into place."""
    paths = [draft, *draft.rglob("*")]
    sync_together(filter(Path.is_file, paths), filter(Path.is_dir, paths))
