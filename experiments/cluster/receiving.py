"""What workers say they have done, held against what they were asked for."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from experiments.cluster.answers import RefusedAnswerError
from experiments.drafts import claim_draft, draft_path, remove_draft
from experiments.planned_runs import PlannedRun
from pipeline.digests import FIELD, RECORD, RecordedFiles
from pipeline.errors import UserError
from pipeline.files import sync_file, sync_folders
from pipeline.locks import is_gone

# Network folders show what others have written with a delay.
SECONDS_TO_APPEAR = 10.0
_SECONDS_BETWEEN_LOOKS = 0.25


def check_in_place(planned: PlannedRun) -> None:
    """Make sure that a run lies in its folder, as a worker says that shares it.

    Raises:
        RefusedAnswerError: if it does not.
    """
    until = time.monotonic() + SECONDS_TO_APPEAR
    while not planned.is_finished:
        if time.monotonic() > until:
            raise RefusedAnswerError("the run is not in its folder, where a worker says it is")
        time.sleep(_SECONDS_BETWEEN_LOOKS)


def receive(planned: PlannedRun, root: Path, files: Mapping[str, bytes]) -> None:
    """Put the files of a run in place, if they are those of this very run, whole.

    Args:
        planned: the run.
        root: the study's folder.
        files: by name, ``run/...`` and ``tensorboard/...``.

    Raises:
        RefusedAnswerError: if they are not.
        OSError: if they cannot be written.
    """
    # It imports what takes long; a driver needs it anyway.
    from experiments.run_in_child import put_run_in_place

    run, log = _part(files, "run/"), _part(files, "tensorboard/")
    if len(run) + len(log) != len(files) or (log and planned.spec.tensorboard_log is None):
        raise RefusedAnswerError("it holds files of no run")
    if is_gone(root):
        raise RefusedAnswerError("the folder of the study is gone")
    draft = draft_path(root, planned)
    claim_draft(draft)
    try:
        _write(draft, run)
        _check(planned, draft, set(run))
        if planned.spec.tensorboard_log is not None:
            shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)
            _write(planned.spec.tensorboard_log, log)
        put_run_in_place(planned, draft)
    except ValueError as error:  # a name that cannot be written
        raise RefusedAnswerError(str(error)) from error
    finally:
        remove_draft(draft)


def _part(files: Mapping[str, bytes], prefix: str) -> dict[str, bytes]:
    return {n.removeprefix(prefix): data for n, data in files.items() if n.startswith(prefix)}


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files for good, the record last of all."""
    for name in sorted(files, key=lambda name: name == RECORD):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            file.write(files[name])
        sync_file(path)
    sync_folders(*{(folder / name).parent for name in files}, folder)


def _check(planned: PlannedRun, draft: Path, names: set[str]) -> None:
    """Make sure that a draft holds this run to its end, and nothing but what the run left."""
    there = replace(planned, path=draft)
    if not there.is_finished:
        raise RefusedAnswerError("it is another run than was asked for, or not at its end")
    try:
        digests = there.run.read_info().get(FIELD)
        if not isinstance(digests, dict) or digests.keys() != names:
            raise RefusedAnswerError("its files are not those that its record lists")
        for name in names - {RECORD}:
            RecordedFiles(draft, digests).check(draft / name)
    except UserError as error:
        raise RefusedAnswerError(str(error)) from error
