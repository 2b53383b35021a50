"""Damaged runs moved aside, so that they are done again and nothing of them is lost."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from experiments.planned_runs import PlannedRun
from experiments.study_results import LeftOut, read_run
from experiments.study_spec import StudySpec
from pipeline.file_digests import DamagedFileError
from pipeline.files import put_in_place
from pipeline.signs_of_life import Tell, tell_nobody


def move_damaged_aside(
    study: StudySpec, planned: Sequence[PlannedRun], tell: Tell = tell_nobody
) -> list[tuple[LeftOut, Path]]:
    """Rename the folder of every run that would be left out.

    Returns:
        These runs with the reason, each with where its folder lies now.
    """
    moved = []
    for place, run in enumerate(planned, start=1):
        tell(f"run {place:,} of {len(planned):,}")
        try:
            read_run(study, run)
        except DamagedFileError as error:
            moved.append((LeftOut(run, str(error)), move_aside(run.path)))
    return moved


def move_aside(folder: Path) -> Path:
    """Rename a folder to ``<its name>.damaged-<n>``, the first that is free; where it is now."""
    names = (folder.with_name(f"{folder.name}.damaged-{n}") for n in itertools.count(1))
    place = next(path for path in names if not path.exists())
    put_in_place(folder, place)
    return place
