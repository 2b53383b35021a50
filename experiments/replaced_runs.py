"""Runs that are there and are not those of the plan: named, and moved aside to be kept."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from pathlib import Path

from experiments.planned_runs import PlannedRun
from pipeline.digests import DamagedFileError
from pipeline.errors import UserError, shown
from pipeline.files import put_in_place

FOLDER = "replaced"
_MOST_NAMED = 3


def in_the_way(planned: Sequence[PlannedRun]) -> list[PlannedRun]:
    """Those whose folder holds another run, or one that was cut off; damaged ones do not count."""
    return [run for run in planned if run.path.exists() and run.is_to_do]


def check_settings_kept(planned: Sequence[PlannedRun], root: Path) -> None:
    """Refuse to do runs again that have finished with other settings.

    Raises:
        UserError: naming how many, in what they differ, and the ways out.
    """
    others = [(run, run.differences) for run in in_the_way(planned)]
    others = [(run, differences) for run, differences in others if differences]
    if not others:
        return
    named: dict[str, str] = {}
    for _, differences in others:
        for key, (there, now) in differences.items():
            named.setdefault(key, f"{key}: {shown(there)} there, {shown(now)} now")
    words = "; ".join(list(named.values())[:_MOST_NAMED])
    words += f"; and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    runs = "1 finished run has" if len(others) == 1 else f"{len(others)} finished runs have"
    raise UserError(
        f"{root}: {runs} other settings ({words}): --name NAME makes another study of it, "
        f"--replace does them again and moves the old ones to {FOLDER}/"
    )


def move_replaced_aside(
    planned: Sequence[PlannedRun], root: Path
) -> tuple[list[PlannedRun], Path | None]:
    """Move all that is in the way of the plan to one folder, ``replaced/<number>``.

    Returns:
        The runs that it was in the way of; and that folder, None where there were none.
    """
    moved = [run for run in in_the_way(planned) if _is_kept_aside(run.path)]
    if not moved:
        return [], None
    place = _new_folder(root)
    for run in moved:
        _move(run, root, place)
    return moved, place


def make_room(planned: PlannedRun, root: Path) -> None:
    """Move aside what is in the way of one run that has been done."""
    with contextlib.suppress(DamagedFileError):
        planned.check_record()
        if planned.path.exists() and not planned.is_finished and _is_kept_aside(planned.path):
            _move(planned, root, _new_folder(root))


def _is_kept_aside(folder: Path) -> bool:
    """Whether there is anything in a folder; one that is empty is removed."""
    with contextlib.suppress(OSError):
        folder.rmdir()
    return folder.exists()


def _move(run: PlannedRun, root: Path, place: Path) -> None:
    target = place / run.path.relative_to(root / "runs")
    target.parent.mkdir(parents=True, exist_ok=True)
    put_in_place(run.path, target)


def _new_folder(root: Path) -> Path:
    for number in itertools.count(1):
        place = root / FOLDER / str(number)
        with contextlib.suppress(FileExistsError):
            place.mkdir(parents=True)
            return place
    raise AssertionError


def move_aside(folder: Path) -> Path:
    """Rename a folder to ``<its name>.damaged-<n>``, the first that is free; where it is now."""
    names = (folder.with_name(f"{folder.name}.damaged-{n}") for n in itertools.count(1))
    place = next(path for path in names if not path.exists())
    put_in_place(folder, place)
    return place
