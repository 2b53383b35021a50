"""Damaged runs moved aside, so that they are done again and nothing of them is lost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.planned_runs import PlannedRun
from experiments.replaced_runs import move_aside
from experiments.study_results import LeftOut, read_run
from experiments.study_spec import StudySpec
from pipeline.digests import DamagedFileError
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
