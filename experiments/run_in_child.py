"""One run of a study, in the process that does it."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
from pathlib import Path

from rich.console import Console

from experiments.bandit_batches import do_batch
from experiments.planned_runs import PlannedRun
from experiments.repair import move_aside
from pipeline.file_digests import DamagedFileError
from pipeline.files import portable_name, put_in_place, sync_folders
from pipeline.run_folder import Run
from pipeline.training import train
from pipeline.user_modules import import_again

LONGEST_DRAFT_NAME = 150  # bytes, besides the numbers and names of process and machine


def draft_path(root: Path, planned: PlannedRun) -> Path:
    """Where a run of this process is written until it is whole."""
    name = portable_name(f"{planned.path.parent.name}@{planned.path.name}", LONGEST_DRAFT_NAME)
    return root / ".drafts" / f"{os.getpid()}@{platform.node()}@{name}"


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
    for folder in (draft.parent, draft.parent.parent):
        with contextlib.suppress(OSError):
            folder.rmdir()


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


def remove_dead_drafts(root: Path) -> None:
    """Remove what processes of this machine that are gone have left."""
    for draft in list((root / ".drafts").glob(f"*@{platform.node()}@*")):
        pid = draft.name.partition("@")[0]
        if not (pid.isdigit() and _is_alive(int(pid))):
            remove_draft(draft)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, also while another run removes those that are empty."""
    for _ in range(1000):
        with contextlib.suppress(FileNotFoundError):
            path.mkdir(parents=True, exist_ok=True)
            return
    path.mkdir(parents=True)


if sys.platform == "win32":
    import _winapi

    def _is_alive(pid: int) -> bool:
        # Here `os.kill` would end the process or send Ctrl-C to it, whatever the signal.
        try:
            process = _winapi.OpenProcess(_winapi.SYNCHRONIZE, False, pid)
        except PermissionError:
            return True
        except OSError:
            return False
        try:
            return _winapi.WaitForSingleObject(process, 0) == _winapi.WAIT_TIMEOUT
        finally:
            _winapi.CloseHandle(process)
else:

    def _is_alive(pid: int) -> bool:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            return True
        return True


def _make_room(planned: PlannedRun) -> None:
    """Remove a run of other settings, or one that was cut off; what is damaged is kept."""
    if not planned.path.exists() or planned.is_finished:
        return
    try:
        planned.check_record()
    except DamagedFileError:
        move_aside(planned.path)
    else:
        shutil.rmtree(planned.path)


def do_run(planned: PlannedRun, draft: Path, command: str) -> None:
    """Train in ``draft``, and rename it into place; another's result that is there stays."""
    import_again(planned.spec.user_modules)
    run = Run(draft, planned.run.env_name)
    claim_draft(draft)
    run.params_path.mkdir()
    if planned.spec.tensorboard_log is not None:
        shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)  # of an earlier try
    if planned.is_batch:
        do_batch(planned.spec, planned.n_runs, run, command)
    else:
        args = {"algo": planned.spec.algo, "env": planned.spec.env_id, "seed": planned.seed}
        train(planned.spec, Console(quiet=True), args, command, run)
    _make_room(planned)
    planned.path.parent.mkdir(parents=True, exist_ok=True)
    try:
        put_in_place(draft, planned.path)
    except OSError:
        if not planned.is_finished:
            raise
    sync_folders(*list(planned.path.parents)[:3])
