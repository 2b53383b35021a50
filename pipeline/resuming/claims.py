"""One process at a time goes on with a run."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.files import put_in_place
from pipeline.liveness import is_alive, mark
from pipeline.run_folder import PROCESS, RUNNING, Run
from safe_files.refusals import UnsafeFileError
from safe_files.regular_files import read_file

_CLAIM = "at_work.json"
_LARGEST = 1 << 16  # bytes
_TRIES = 10


@contextmanager
def claimed(run: Run) -> Iterator[None]:
    """Keep others from going on with a run inside the ``with`` statement.

    Raises:
        UserError: if another process is at work on it, or may be.
    """
    info = run.read_info()
    if info.get("state") == RUNNING:
        _check_gone(run, info.get(PROCESS))
    run.state_path.mkdir(exist_ok=True)
    path = run.state_path / _CLAIM
    _claim(run, path)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            run.state_path.rmdir()


def _claim(run: Run, path: Path) -> None:
    for _ in range(_TRIES):
        draft = path.with_name(f".{secrets.token_hex(8)}.tmp")
        draft.write_text(json.dumps(mark()), encoding="utf-8")
        try:
            # Unlike a rename, a link replaces nothing.
            os.link(draft, path)
        except FileExistsError:
            _remove_if_gone(run, path)
        else:
            return
        finally:
            draft.unlink(missing_ok=True)
    raise UserError(f"{run.path}: another process is at work on it")


def _remove_if_gone(run: Run, path: Path) -> None:
    """Remove the claim of a process that is gone, and of no other that may come between."""
    _check_gone(run, _read(path))
    aside = path.with_name(f".{secrets.token_hex(8)}.tmp")
    with contextlib.suppress(FileNotFoundError):
        put_in_place(path, aside)
        if is_alive(_read(aside)) is not False:
            put_in_place(aside, path)
        aside.unlink(missing_ok=True)


def _check_gone(run: Run, record: Any) -> None:
    if record is None:
        return
    pid = record.get("pid") if isinstance(record, dict) else None
    host = record.get("host") if isinstance(record, dict) else None
    alive = is_alive(record)
    if alive:
        raise UserError(f"{run.path}: process {pid} is at work on it")
    if alive is None:
        raise UserError(
            f"{run.path}: process {pid} on {host} may be at work on it, which cannot be told from "
            f"here; if it is not, remove {run.state_path / _CLAIM}"
        )


def _read(path: Path) -> Any:
    try:
        return json.loads(read_file(path, _LARGEST))
    except (OSError, ValueError, UnsafeFileError):
        return None
