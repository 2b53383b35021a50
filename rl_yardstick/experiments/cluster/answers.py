"""Answers of workers: how a run ended, and its files if no folder is shared.

An answer is a zip, preceded by its SHA-256, which reveals damage. The reader trusts nothing in it:
it checks names and sizes before it writes anything, and then the run's spec and the digests in
its record.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import time
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from rl_yardstick.experiments.cluster.sent_code import SentCode
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.run_folders import (
    claim_draft,
    draft_path,
    put_run_in_place,
    remove_draft,
)
from rl_yardstick.pipeline.digests import FIELD, RECORD, RecordedFiles
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import portable_name, sync
from rl_yardstick.pipeline.locks import is_gone
from rl_yardstick.safe_files.archives import read_members
from rl_yardstick.safe_files.files import UnsafeFileError

# UNFIT: the worker has other code than the driver.
DONE, FAILED, STOPPED, UNFIT = "done", "failed", "stopped", "unfit"
KINDS = (DONE, FAILED, STOPPED, UNFIT)
LARGEST = 256 << 20  # bytes, of all files of a run
MOST_FILES = 10_000
LONGEST_TEXT = 200_000  # characters
_HEAD = "answer.json"  # the member that says how the run ended
_LONGEST_PATH = 1000
_DEEPEST = 8  # folders


class RefusedAnswerError(ValueError):
    """Bytes are not a valid answer, or contain something forbidden."""


@dataclass(frozen=True)
class Answer:
    """A worker's answer about a run."""

    kind: str  # one of `KINDS`
    reason: str = ""  # why it failed
    details: str = ""  # the reason at length
    # The run's files by relative name; None if they are already in their place.
    files: dict[str, bytes] | None = field(default=None, repr=False)


def packed(answer: Answer) -> bytes:
    """Convert an answer to bytes."""
    head = {
        "kind": answer.kind,
        "reason": answer.reason[:LONGEST_TEXT],
        "details": answer.details[-LONGEST_TEXT:],
        "has_files": answer.files is not None,
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(_HEAD, json.dumps(head))
        for name, content in (answer.files or {}).items():
            archive.writestr(name, content)
    return sealed(buffer.getvalue())


def sealed(content: bytes) -> bytes:
    """Bytes preceded by their SHA-256."""
    return hashlib.sha256(content).digest() + content


def unpacked(content: object) -> Answer:
    """Read an answer from bytes; refuses other data, and files that must not be written."""
    if not isinstance(content, bytes):
        raise RefusedAnswerError(f"it is a {type(content).__name__}, and not bytes")
    archive = content[hashlib.sha256().digest_size :]
    if sealed(archive) != content:
        raise RefusedAnswerError("it is damaged")
    try:
        files = read_members(archive)
        head = json.loads(files.pop(_HEAD, b""))
    except UnsafeFileError as error:
        raise RefusedAnswerError(f"it {error}") from error
    except (ValueError, RecursionError) as error:
        raise RefusedAnswerError("its head is no JSON") from error
    match head:
        case {"kind": str(kind), "reason": str(reason), "details": str(details)}:
            pass
        case _:
            raise RefusedAnswerError("its head lacks a text")
    if kind not in KINDS:
        raise RefusedAnswerError(f"{kind[:20]!a} is no way to end")
    if max(len(reason), len(details)) > LONGEST_TEXT or sum(map(len, files.values())) > LARGEST:
        raise RefusedAnswerError("it is too large")
    _check_names(files)
    return Answer(kind, reason, details, files if head.get("has_files") else None)


def files_in(folder: Path, prefix: str) -> dict[str, bytes]:
    """All files in a folder, by relative name after a prefix; ValueError if they are too many."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    size = sum(path.stat().st_size for path in paths)
    if size > LARGEST or len(paths) > MOST_FILES:
        raise ValueError(
            f"left {len(paths):,} files of {size:,} bytes, and a worker that shares no folder can "
            f"send {MOST_FILES:,} of {LARGEST:,}: let it share the study's folder"
        )
    return {prefix + path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _check_names(names: Collection[str]) -> None:
    """Refuse names that lead elsewhere, or that are not valid on every system."""
    for name in names:
        parts = name.split("/")
        if len(name) > _LONGEST_PATH or not 2 <= len(parts) <= _DEEPEST:
            raise RefusedAnswerError(f"{name[:80]!a} is no name of a file that a run leaves")
        for part in parts:
            if part in ("", ".", "..") or portable_name(part, 255) != part:
                raise RefusedAnswerError(f"{name!a} would lie elsewhere")
    # Some file systems ignore case.
    folded = {name.casefold() for name in names}
    if len(folded) < len(names):
        raise RefusedAnswerError("it lists a file twice")
    if not folded.isdisjoint(
        str(parent) for name in folded for parent in PurePosixPath(name).parents
    ):
        raise RefusedAnswerError("a file in it is a folder too")


# --- Checks of the workers' answers against their orders.

# Network folders show files of other machines with a delay.
SECONDS_TO_APPEAR = 10.0
_SECONDS_BETWEEN_LOOKS = 0.25


def check_in_place(planned: PlannedRun) -> None:
    """Check that a run is in its folder, as a worker that shares the folder has reported."""
    until = time.monotonic() + SECONDS_TO_APPEAR
    while not planned.is_finished:
        if time.monotonic() > until:
            raise RefusedAnswerError("the run is not in its folder, where a worker says it is")
        time.sleep(_SECONDS_BETWEEN_LOOKS)
    if not SentCode.of(planned.spec).is_recorded_in(planned.run.read_info()):
        shutil.rmtree(planned.path)
        raise RefusedAnswerError("the run was made with other code than this")


def receive(planned: PlannedRun, root: Path, files: Mapping[str, bytes]) -> None:
    """Put files ``run/...`` and ``tensorboard/...`` in place, if they belong to this run."""
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
    except ValueError as error:  # an invalid file name
        raise RefusedAnswerError(str(error)) from error
    finally:
        remove_draft(draft)


def _part(files: Mapping[str, bytes], prefix: str) -> dict[str, bytes]:
    return {n.removeprefix(prefix): data for n, data in files.items() if n.startswith(prefix)}


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files durably, the record last."""
    for name in sorted(files, key=lambda name: name == RECORD):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            file.write(files[name])
    written = {folder / name for name in files}
    sync(*written, *{path.parent for path in written}, folder)


def _check(planned: PlannedRun, draft: Path, names: set[str]) -> None:
    """Check that a draft contains this finished run, and no other files."""
    there = replace(planned, path=draft)
    if not there.is_finished:
        raise RefusedAnswerError("it is another run than was asked for, or not at its end")
    try:
        info = there.run.read_info()
        if not SentCode.of(planned.spec).is_recorded_in(info):
            raise RefusedAnswerError("it was made with other code than this")
        digests = info.get(FIELD)
        if not isinstance(digests, dict) or digests.keys() != names:
            raise RefusedAnswerError("its files are not those that its record lists")
        for name in names - {RECORD}:
            RecordedFiles(draft, digests).check(draft / name)
    except UserError as error:
        raise RefusedAnswerError(str(error)) from error
