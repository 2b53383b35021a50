"""Runs that are being written: whose they are, and what becomes of them when their process is gone.

A draft is called ``<process>@<machine>@<run>``. One that holds a state to go on from is kept when
its process ends before it; the next process that does this run takes it over, by renaming it. So is
one without a state, of a process that was killed: it says that states have to come sooner.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import shutil
from collections.abc import Collection
from pathlib import Path

from experiments.planned_runs import PlannedRun
from pipeline import liveness
from pipeline.file_digests import STATE_FOLDER
from pipeline.files import portable_name
from pipeline.folder_clock import seconds_silent
from pipeline.run_files import has_state

FOLDER = ".drafts"
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
    return root / FOLDER / f"{_own_mark()}@{platform.node()}@{run_name(planned)}"


def _own_mark() -> str:
    mark = liveness.mark()
    return f"{mark['pid']}-{mark['began'] or 0}-{_place(mark)}"


def _is_own(draft: Path) -> bool:
    return draft.name.startswith(f"{_own_mark()}@")


def _place(mark: dict[str, object]) -> str:
    """Where the numbers of processes mean what they mean in the process of the mark."""
    named = "\n".join(str(mark[name]) for name in _NAMING)
    return hashlib.sha256(named.encode()).hexdigest()[:8]


def _is_dead(draft: Path) -> bool:
    """Whether the process that wrote a draft is certainly gone."""
    mark, owner = liveness.mark(), _OWNER.match(draft.name)
    if owner is not None and owner[3] == _place(mark):
        began = int(owner[2]) or None
        return liveness.is_alive({**mark, "pid": int(owner[1]), "began": began}) is False
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
        return sorted(path for path in (root / FOLDER).iterdir() if path.is_dir())
    return []


def _run_of(draft: Path) -> str:
    """The name of the run that a draft is of."""
    return draft.name.split("@", 2)[-1]


def take_over(draft: Path) -> bool:
    """Make ``draft`` of what a process that is gone has left of the same run.

    Returns:
        Whether there was anything.
    """
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
    for _ in range(1000):
        make_folder(draft.parent)
        with contextlib.suppress(FileExistsError, FileNotFoundError):
            draft.mkdir()
            return
        if os.path.lexists(draft):
            remove_draft(draft)
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
    """Remove what this process, or one that is gone, has not finished of a run.

    What can be gone on from stays.

    Args:
        root: the study's folder.
        name: of the run, see `run_name`.
    """
    for draft in _drafts(root):
        is_left = _run_of(draft) == name and (_is_own(draft) or _is_dead(draft))
        if is_left and not holds_state(draft):
            remove_draft(draft)
    _remove_empty(root / FOLDER)


def remove_dead_drafts(root: Path, kept: Collection[str] = ()) -> None:
    """Remove what processes that are gone have left.

    Args:
        root: the study's folder.
        kept: names of runs that are to be done, by whom theirs are taken over.
    """
    for draft in _drafts(root):
        if _is_dead(draft) and _run_of(draft) not in kept:
            remove_draft(draft)
    _remove_empty(root / FOLDER)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, also while another run removes those that are empty."""
    for _ in range(1000):
        # Also a folder that is there, but no longer when it is looked at, "exists".
        with contextlib.suppress(FileNotFoundError, FileExistsError):
            path.mkdir(parents=True, exist_ok=True)
            return
    path.mkdir(parents=True, exist_ok=True)
