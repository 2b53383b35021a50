"""Folders of runs that are being written, and of runs that are not those of the plan.

A draft is called ``<process>@<machine>@<run>``. One that holds a state to go on from is kept when
its process ends before it; the next process that does this run takes it over, by renaming it. So is
one without a state, of a process that was killed: it says that states have to come sooner.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import platform
import re
import shutil
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.plan import PlannedRun
from experiments.study import StudySpec
from pipeline import locks
from pipeline.digests import STATE_FOLDER, DamagedFileError
from pipeline.errors import UserError, shown
from pipeline.files import portable_name, put_in_place, settle, sync
from pipeline.locks import seconds_silent
from pipeline.runs import has_state
from pipeline.signs_of_life import Tell, tell_nobody

if TYPE_CHECKING:
    from experiments.results import LeftOut

DRAFTS_FOLDER = ".drafts"
LONGEST_DRAFT_NAME = 150  # bytes, besides the numbers and names of process and machine
# After this long without a sign, a process elsewhere counts as gone: sooner than a lock, so that
# whoever takes over the lock of a driver finds its drafts to be free.
SECONDS_OF_SILENCE = 45.0

_OWNER = re.compile(r"(\d{1,10})-(\d{1,20})-([0-9a-f]{8})@")
_NAMING = ("host", "machine", "boot", "namespace")


def run_name(planned: PlannedRun) -> str:
    """What a run is called among the drafts of its study."""
    return portable_name(f"{planned.path.parent.name}@{planned.path.name}", LONGEST_DRAFT_NAME)


def draft_path(root: Path, planned: PlannedRun) -> Path:
    """Where a run of this process is written until it is whole."""
    return root / DRAFTS_FOLDER / f"{_own_mark()}@{platform.node()}@{run_name(planned)}"


def _own_mark() -> str:
    mark = locks.mark()
    return f"{mark['pid']}-{mark['began'] or 0}-{_place(mark)}"


def _place(mark: dict[str, object]) -> str:
    """Where the numbers of processes mean what they mean in the process of the mark."""
    named = "\n".join(str(mark[name]) for name in _NAMING)
    return hashlib.sha256(named.encode()).hexdigest()[:8]


def _is_dead(draft: Path) -> bool:
    """Whether the process that wrote a draft is certainly gone."""
    mark, owner = locks.mark(), _OWNER.match(draft.name)
    if owner is not None and owner[3] == _place(mark):
        began = int(owner[2]) or None
        return locks.is_alive({**mark, "pid": int(owner[1]), "began": began}) is False
    try:
        return seconds_silent(draft) > SECONDS_OF_SILENCE
    except OSError:
        return False


def holds_state(draft: Path) -> bool:
    """Whether there is something in a draft to go on from."""
    state = draft / STATE_FOLDER
    return not draft.is_symlink() and not state.is_symlink() and has_state(state)


def _drafts(root: Path) -> list[Path]:
    with contextlib.suppress(OSError):
        return sorted(path for path in (root / DRAFTS_FOLDER).iterdir() if path.is_dir())
    return []


def _run_of(draft: Path) -> str:
    """The name of the run that a draft is of."""
    return draft.name.split("@", 2)[-1]


def take_over(draft: Path) -> bool:
    """Make ``draft`` of what a process that is gone has left of the run; whether it left any."""
    left = [
        one
        for one in _drafts(draft.parent.parent)
        if one != draft
        and not one.is_symlink()
        and _run_of(one) == _run_of(draft)
        and _is_dead(one)
    ]
    for one in sorted(left, key=holds_state, reverse=True):
        with contextlib.suppress(OSError):  # another was faster
            one.replace(draft)
            return True
    return False


def claim_draft(draft: Path) -> None:
    """Make the folder of a run that begins, as a new one.

    Others can tell its name beforehand: what is there already is an earlier process's, or a link to
    where the run should not write, and is removed.
    """
    for _ in range(1000):  # other runs remove the folder of drafts whenever it is empty
        with contextlib.suppress(FileExistsError, FileNotFoundError):
            draft.parent.mkdir(parents=True, exist_ok=True)
            draft.mkdir()
            return
        if os.path.lexists(draft):
            remove_draft(draft)
    draft.parent.mkdir(parents=True, exist_ok=True)
    draft.mkdir()


def remove_draft(draft: Path) -> None:
    """Remove what an unfinished run has left, even while it is being written."""
    dead = draft.with_name(f"{draft.name}.dead")
    with contextlib.suppress(OSError):
        draft.replace(dead)
    # Windows does not rename a folder of which a file is open.
    for folder in (dead, draft):
        shutil.rmtree(folder, ignore_errors=True)
        if folder.is_symlink():
            folder.unlink(missing_ok=True)
    _remove_empty(draft.parent)


def _remove_empty(folder: Path) -> None:
    """Remove the folder of drafts if it is empty, and then the study's own if that is."""
    with contextlib.suppress(OSError):
        folder.rmdir()
        folder.parent.rmdir()


def leave_drafts(root: Path, name: str) -> None:
    """Remove what this process, or one that is gone, has not finished of the run of this name.

    What can be gone on from stays.
    """
    for draft in _drafts(root):
        is_left = _run_of(draft) == name and (
            draft.name.startswith(f"{_own_mark()}@") or _is_dead(draft)
        )
        if is_left and not holds_state(draft):
            remove_draft(draft)
    _remove_empty(root / DRAFTS_FOLDER)


def remove_dead_drafts(root: Path, kept: Collection[str] = ()) -> None:
    """Remove what processes that are gone have left, but of ``kept`` runs, which are to be done."""
    for draft in _drafts(root):
        if _is_dead(draft) and _run_of(draft) not in kept:
            remove_draft(draft)
    _remove_empty(root / DRAFTS_FOLDER)


# --- Runs that are there and are not those of the plan, or damaged: moved aside and kept.

REPLACED_FOLDER = "replaced"
_MOST_NAMED = 3


def in_the_way(planned: Sequence[PlannedRun]) -> list[PlannedRun]:
    """Those whose folder holds another run, or one that was cut off; damaged ones do not count."""
    return [run for run in planned if run.path.exists() and run.is_to_do]


def check_settings_kept(planned: Sequence[PlannedRun], root: Path) -> None:
    """Refuse to do runs again that have finished with other settings, and name the ways out."""
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
        f"--replace does them again and moves the old ones to {REPLACED_FOLDER}/"
    )


def move_replaced_aside(
    planned: Sequence[PlannedRun], root: Path
) -> tuple[list[PlannedRun], Path | None]:
    """Move all that is in the way of the plan to one folder, ``replaced/<number>``.

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


def put_run_in_place(planned: PlannedRun, draft: Path) -> None:
    """Rename a draft that is whole; another's result that is there stays, and others give way."""
    settle(draft)
    try:
        planned.check_record()
    except DamagedFileError:
        move_aside(planned.path)
    make_room(planned, draft.parent.parent)
    planned.path.parent.mkdir(parents=True, exist_ok=True)
    try:
        put_in_place(draft, planned.path)
    except OSError:
        if not planned.is_finished:
            raise
    sync(*list(planned.path.parents)[:3])


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
        place = root / REPLACED_FOLDER / str(number)
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


def move_damaged_aside(
    study: StudySpec, planned: Sequence[PlannedRun], tell: Tell = tell_nobody
) -> list[tuple[LeftOut, Path]]:
    """Rename the folder of every run that would be left out; each with where it lies now."""
    from experiments.results import LeftOut, read_run

    moved = []
    for place, run in enumerate(planned, start=1):
        tell(f"run {place:,} of {len(planned):,}")
        try:
            read_run(study, run)
        except DamagedFileError as error:
            moved.append((LeftOut(run, str(error)), move_aside(run.path)))
    return moved
