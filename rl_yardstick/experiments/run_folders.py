"""Manages drafts of running runs, and moves aside runs that do not match the plan.

A draft is called ``<process>@<machine>@<run>``. If its process ends before the run, a draft with a
saved state is kept; the next process that does this run takes it over by renaming it. A draft
without a state, of a killed process, is taken over too: it shows that saves must come sooner.
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
from typing import TYPE_CHECKING, Any

from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.pipeline import locks
from rl_yardstick.pipeline.digests import STATE_FOLDER, DamagedFileError
from rl_yardstick.pipeline.errors import UserError, shown
from rl_yardstick.pipeline.files import portable_name, put_in_place, settle, sync
from rl_yardstick.pipeline.locks import seconds_silent
from rl_yardstick.pipeline.runs import has_state
from rl_yardstick.pipeline.signs_of_life import Tell, tell_nobody

if TYPE_CHECKING:
    from rl_yardstick.experiments.results import LeftOut

DRAFTS_FOLDER = ".drafts"
LONGEST_DRAFT_NAME = 150  # bytes, in addition to process number and machine name
# Time-out of heartbeats, after which a process elsewhere counts as dead: shorter than that of a
# lock, so that a process that takes over a driver's lock finds its drafts free.
SECONDS_OF_SILENCE = 45.0

_OWNER = re.compile(r"(\d{1,10})-(\d{1,20})-([0-9a-f]{8})@")
_NAMING = ("host", "machine", "boot", "namespace")


def run_name(planned: PlannedRun) -> str:
    """The name of a run among the drafts of its study."""
    return portable_name(f"{planned.path.parent.name}@{planned.path.name}", LONGEST_DRAFT_NAME)


def draft_path(root: Path, planned: PlannedRun) -> Path:
    """The folder in which this process writes a run until it is complete."""
    return root / DRAFTS_FOLDER / f"{_own_mark()}@{platform.node()}@{run_name(planned)}"


def _own_mark() -> str:
    mark = locks.mark()
    return f"{mark['pid']}-{mark['began'] or 0}-{_place(mark)}"


def _place(mark: dict[str, object]) -> str:
    """A digest of the namespace in which a mark's process number is valid."""
    named = "\n".join(str(mark[name]) for name in _NAMING)
    return hashlib.sha256(named.encode()).hexdigest()[:8]


def _is_dead(draft: Path) -> bool:
    """Whether the process that wrote a draft is certainly dead."""
    mark, owner = locks.mark(), _OWNER.match(draft.name)
    if owner is not None and owner[3] == _place(mark):
        began = int(owner[2]) or None
        return locks.is_alive({**mark, "pid": int(owner[1]), "began": began}) is False
    try:
        return seconds_silent(draft) > SECONDS_OF_SILENCE
    except OSError:
        return False


def holds_state(draft: Path) -> bool:
    """Whether a draft contains a saved state."""
    state = draft / STATE_FOLDER
    return not draft.is_symlink() and not state.is_symlink() and has_state(state)


def _drafts(root: Path) -> list[Path]:
    with contextlib.suppress(OSError):
        return sorted(path for path in (root / DRAFTS_FOLDER).iterdir() if path.is_dir())
    return []


def _run_of(draft: Path) -> str:
    """The name of a draft's run."""
    return draft.name.split("@", 2)[-1]


def take_over(draft: Path) -> bool:
    """Rename a dead process's draft of the run to ``draft``; returns whether there was one."""
    left = [
        one
        for one in _drafts(draft.parent.parent)
        if one != draft
        and not one.is_symlink()
        and _run_of(one) == _run_of(draft)
        and _is_dead(one)
    ]
    for one in sorted(left, key=holds_state, reverse=True):
        with contextlib.suppress(OSError):  # another process was faster
            one.replace(draft)
            return True
    return False


def claim_draft(draft: Path) -> None:
    """Make the folder of a new run.

    Its name is predictable: an existing folder belongs to an earlier process, or is a link to a
    place where the run must not write, and is removed.
    """
    for _ in range(1000):  # other runs remove the drafts' folder when it is empty
        with contextlib.suppress(FileExistsError, FileNotFoundError):
            draft.parent.mkdir(parents=True, exist_ok=True)
            draft.mkdir()
            return
        if os.path.lexists(draft):
            remove_draft(draft)
    draft.parent.mkdir(parents=True, exist_ok=True)
    draft.mkdir()


def remove_draft(draft: Path) -> None:
    """Remove the draft of an unfinished run, even while it is being written."""
    dead = draft.with_name(f"{draft.name}.dead")
    with contextlib.suppress(OSError):
        draft.replace(dead)
    # Windows does not rename a folder with an open file.
    for folder in (dead, draft):
        shutil.rmtree(folder, ignore_errors=True)
        if folder.is_symlink():
            folder.unlink(missing_ok=True)
    _remove_empty(draft.parent)


def _remove_empty(folder: Path) -> None:
    """Remove the folder of drafts if it is empty, and then the study's folder likewise."""
    with contextlib.suppress(OSError):
        folder.rmdir()
        folder.parent.rmdir()


def leave_drafts(root: Path, name: str) -> None:
    """Remove drafts of a run by this process or dead ones.

    Keeps drafts with a saved state.
    """
    for draft in _drafts(root):
        is_left = _run_of(draft) == name and (
            draft.name.startswith(f"{_own_mark()}@") or _is_dead(draft)
        )
        if is_left and not holds_state(draft):
            remove_draft(draft)
    _remove_empty(root / DRAFTS_FOLDER)


def remove_dead_drafts(root: Path, kept: Collection[str] = ()) -> None:
    """Remove drafts of dead processes, except of ``kept`` runs, which are still to be done."""
    for draft in _drafts(root):
        if _is_dead(draft) and _run_of(draft) not in kept:
            remove_draft(draft)
    _remove_empty(root / DRAFTS_FOLDER)


# --- Existing runs that do not match the plan, or are damaged: moved aside and kept.

REPLACED_FOLDER = "replaced"
_MOST_NAMED = 3

Differences = dict[str, tuple[Any, Any]]  # by name, a setting there and the requested one


def in_the_way(planned: Sequence[PlannedRun]) -> list[PlannedRun]:
    """The planned runs whose folder has another or an unfinished run; ignores damaged ones."""
    return [run for run in planned if run.path.exists() and run.is_to_do]


def check_settings_kept(
    planned: Sequence[PlannedRun], root: Path, stored: Sequence[tuple[int, Differences]] = ()
) -> None:
    """Refuse to repeat runs that finished with other settings, and name the ways out.

    ``stored`` has the number of runs and the differences for each file with other settings.
    """
    found = [(1, run.differences) for run in in_the_way(planned)]
    others = [each for each in (*found, *stored) if each[1]]
    if not others:
        return
    n_others = sum(n for n, _ in others)
    named: dict[str, str] = {}
    for _, differences in others:
        for key, (there, now) in differences.items():
            named.setdefault(key, f"{key}: {shown(there)} there, {shown(now)} now")
    words = "; ".join(list(named.values())[:_MOST_NAMED])
    words += f"; and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    runs = "1 finished run has" if n_others == 1 else f"{n_others} finished runs have"
    raise UserError(
        f"{root}: {runs} other settings ({words}): --name NAME makes another study of it, "
        f"--replace does them again and moves the old ones to {REPLACED_FOLDER}/"
    )


def move_replaced_aside(
    planned: Sequence[PlannedRun], root: Path
) -> tuple[list[PlannedRun], Path | None]:
    """Move all folders in the way of the plan to ``replaced/<number>``.

    Returns the runs whose folders were moved, and the new folder, or None.
    """
    moved = [run for run in in_the_way(planned) if _is_kept_aside(run.path)]
    if not moved:
        return [], None
    place = new_folder(root)
    for run in moved:
        _move(run, root, place)
    return moved, place


def make_room(planned: PlannedRun, root: Path) -> None:
    """Move aside the folder in the way of one finished draft."""
    with contextlib.suppress(DamagedFileError):
        planned.check_record()
        if planned.path.exists() and not planned.is_finished and _is_kept_aside(planned.path):
            _move(planned, root, new_folder(root))


def put_run_in_place(planned: PlannedRun, draft: Path) -> None:
    """Rename a complete draft into place; a finished result of another process stays."""
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
    """Whether a folder has contents; removes an empty one."""
    with contextlib.suppress(OSError):
        folder.rmdir()
    return folder.exists()


def _move(run: PlannedRun, root: Path, place: Path) -> None:
    move_to(place, run.path, root)


def move_to(place: Path, path: Path, root: Path) -> None:
    """Move a run folder, or a file of runs, to ``place``, below the same folders."""
    target = place / path.relative_to(root / "runs")
    target.parent.mkdir(parents=True, exist_ok=True)
    put_in_place(path, target)


def new_folder(root: Path) -> Path:
    """Make the next free folder ``replaced/<number>``."""
    for number in itertools.count(1):
        place = root / REPLACED_FOLDER / str(number)
        with contextlib.suppress(FileExistsError):
            place.mkdir(parents=True)
            return place
    raise AssertionError


def move_aside(folder: Path) -> Path:
    """Rename a folder to the first free ``<its name>.damaged-<n>``; returns the new path."""
    names = (folder.with_name(f"{folder.name}.damaged-{n}") for n in itertools.count(1))
    place = next(path for path in names if not path.exists())
    put_in_place(folder, place)
    return place


def move_damaged_aside(
    study: StudySpec, planned: Sequence[PlannedRun], tell: Tell = tell_nobody
) -> list[tuple[LeftOut, Path]]:
    """Rename the folders of damaged runs; returns each run with its new path."""
    from rl_yardstick.experiments.results import LeftOut, read_run

    moved = []
    for place, run in enumerate(planned, start=1):
        tell(f"run {place:,} of {len(planned):,}")
        try:
            read_run(study, run)
        except DamagedFileError as error:
            moved.append((LeftOut(run, str(error)), move_aside(run.path)))
    return moved
