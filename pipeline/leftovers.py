"""What processes that are gone have left among the runs: cleared away before the next is begun."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from pipeline.errors import UserError
from pipeline.file_digests import LOCK, RECORD
from pipeline.files import drafts_in
from pipeline.locks import is_alive
from pipeline.module_records import COPIES
from pipeline.run_files import environment_name
from pipeline.run_folder import PROCESS, ROOM, RUNNING, Run, numbered_runs

_CLAIM = re.compile(r"\.(.+)\.[0-9a-f]{16}\.tmp")


def remove_leftovers(log_folder: Path, algo: str, env_id: str) -> None:
    """Remove half-written files of runs that were killed, and runs killed before their first step.

    Only what a process that is certainly gone has written is touched, and no folder that holds
    anything else. What cannot be removed stays.
    """
    for run in _unfinished(log_folder / algo, environment_name(env_id)):
        with contextlib.suppress(OSError, UserError):
            drafts = drafts_in(run.path)  # before looking: who goes on with a run may write some
            info = run.read_info()
            if info.get("state") != RUNNING or is_alive(info.get(PROCESS)) is not False:
                continue
            if "spec" not in info and _is_mere_set_up(run):
                _remove(run.path)
                continue
            for draft in drafts:
                draft.unlink(missing_ok=True)


def _unfinished(parent: Path, env_name: str) -> Iterator[Run]:
    """The runs that have no model, or half-written files; also those that have no number yet."""
    for _, path in numbered_runs(parent, env_name):
        run = Run(path, env_name)
        is_own = path.is_dir() and not path.is_symlink()
        if is_own and (not run.model_path.exists() or drafts_in(path)):
            yield run
    for path in list(parent.glob(".*.tmp")):
        claim = _CLAIM.fullmatch(path.name)
        if claim is not None and path.is_dir() and not path.is_symlink():
            yield Run(path, claim[1])


def _is_mere_set_up(run: Run) -> bool:
    """Whether nothing lies in the folder but what is written before the first step."""
    own_files = "|".join(map(re.escape, (RECORD, LOCK, ROOM)))
    own = re.compile(
        rf"{own_files}|\d+\.monitor\.csv|{re.escape(run.env_name)}(/(config|args)\.yml|/command\.txt)?"
        rf"|{COPIES}(/.+\.py)?|(.+/)?\.[^/]+\.[0-9a-f]{{16}}\.tmp"
    )
    paths = (
        p for p in run.path.rglob("*") if p.is_symlink() or not (p.is_dir() and any(p.iterdir()))
    )
    names = (path.relative_to(run.path).as_posix() for path in paths)
    return all(own.fullmatch(name) and not (run.path / name).is_symlink() for name in names)


def _remove(folder: Path) -> None:
    """Remove a folder, unless something comes into it meanwhile."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            (Path(parent) / name).unlink(missing_ok=True)
        Path(parent).rmdir()
