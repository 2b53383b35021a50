"""One process at a time on a study or a run: a file says who is at work, and the dead hold none.

The file appears in one step, as a link to one that is written already; that works on network
folders too. Its owner gives signs of life. On the machine where it was made the process itself is
looked for; elsewhere an owner counts as gone once it has been silent for a minute.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline import liveness
from pipeline.errors import UserError, visible
from pipeline.file_digests import LOCK
from pipeline.folder_clock import (
    SECONDS_BETWEEN_SIGNS,
    give_sign,
    last_sign,
    remove_remains,
    seconds_silent,
)
from pipeline.signs_of_life import Heartbeat
from safe_files.files import NEW, UnsafeFileError, open_number, read_file

SECONDS_OF_SILENCE = 60.0
_SECONDS_BETWEEN_LOOKS = 0.2
_LARGEST = 10_000  # bytes
_GONE: dict[str, Any] = {}  # told from others by being this one


class FolderInUseError(UserError):
    """Another process is at work in the folder."""


class FolderGoneError(UserError):
    """A folder that this process works on has been removed or renamed."""

    def __init__(self, root: Path) -> None:
        super().__init__(f"{root}: this folder is gone: somebody has removed or renamed it")


def is_gone(path: Path) -> bool:
    """Whether there is no such file or folder, which is more than that it cannot be reached."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False


@contextmanager
def told_if_gone(root: Path) -> Iterator[None]:
    """Say that a folder is gone, in place of whatever fails by that in the ``with`` statement.

    Raises:
        FolderGoneError: if it is.
    """
    try:
        yield
    except Exception as error:
        if is_gone(root):
            raise FolderGoneError(root) from error
        raise
    if is_gone(root):
        raise FolderGoneError(root)


@contextmanager
def folder_lock(
    root: Path, on_loss: Callable[[], object], say: Callable[[str], object]
) -> Iterator[None]:
    """Be the only process at work in a folder inside the ``with`` statement.

    Args:
        root: the folder; it is made, and removed again if nothing else came into it.
        on_loss: called in another thread if the lock is lost: it has to end the work.
        say: told in a line why it takes long, where it does.

    Raises:
        FolderInUseError: if another process is at work, saying who; also at the end, if one has
            taken this one for dead.
        FolderGoneError: if somebody has removed the folder.
        UnsafeFileError: if a link, a pipe or a device lies in the place of the lock.
    """
    lost: list[UserError] = []

    def lose(error: UserError) -> None:
        if not lost:
            lost.append(error)
            on_loss()

    made = _make_folders(root)
    path, token = root / LOCK, secrets.token_hex(16)
    try:
        _take(path, token, say)
        remove_remains(root)
        heart = Heartbeat(lambda: _beat(path, token, lose), SECONDS_BETWEEN_SIGNS)
        heart.start()
        try:
            yield
        except KeyboardInterrupt as stop:
            if lost:  # nobody else asked for it
                raise lost[0] from stop
            raise
        finally:
            heart.stop()
            remove_remains(root)
            if _read(path).get("token") == token:
                path.unlink(missing_ok=True)
        if lost:
            raise lost[0]
    finally:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _make_folders(root: Path) -> list[Path]:
    """Make the folder; those that were not there, innermost first."""
    missing = [folder for folder in (root, *root.parents) if not folder.exists()]
    root.mkdir(parents=True, exist_ok=True)
    return missing


def _take(path: Path, token: str, say: Callable[[str], object]) -> None:
    mark = {**liveness.mark(), "token": token, "since": time.strftime("%Y-%m-%d %H:%M:%S")}
    while not _appears(path, json.dumps(mark)):
        owner = _read(path)
        if _is_at_work(path, owner, say):
            raise FolderInUseError(_words(path.parent, owner))
        _remove_dead(path, owner)


def _appears(path: Path, content: str) -> bool:
    """Let the lock appear, whole; whether it was not there."""
    draft = path.with_name(f"{LOCK}.{secrets.token_hex(8)}.tmp")
    try:
        with os.fdopen(open_number(draft, NEW), "wb") as file:
            file.write(content.encode())
        os.link(draft, path)
    except FileExistsError:
        return False
    except FileNotFoundError:
        if path.parent.is_dir():
            return False  # who has the lock has cleared the draft away
        raise
    except OSError:  # a file system without links: the lock is empty for an instant
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(content)
        except FileExistsError:
            return False
        except OSError:  # the disk is full, or read-only
            _unlink(path)
            raise
    finally:
        _unlink(draft)
    return True


def _unlink(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def _read(path: Path) -> dict[str, Any]:
    """What a lock says; nothing where it says nothing, and that it is gone where it is."""
    try:
        owner = json.loads(read_file(path, _LARGEST))
    except FileNotFoundError:
        return _GONE
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _is_at_work(path: Path, owner: dict[str, Any], say: Callable[[str], object]) -> bool:
    """Whether the owner of a lock is there; one that is elsewhere is waited for, until it shows."""
    is_alive = liveness.is_alive(owner)
    if is_alive is not None:
        return is_alive
    has_said = False
    try:
        first = last_sign(path)
        while (silent := seconds_silent(path)) <= SECONDS_OF_SILENCE:
            if last_sign(path) != first:
                return True
            if not has_said and silent > 2 * SECONDS_BETWEEN_SIGNS:
                say(f"waiting for a sign of life: {_words(path.parent, owner)}")
                has_said = True
            time.sleep(_SECONDS_BETWEEN_LOOKS)
    except FileNotFoundError:
        pass  # it has just ended
    return False


def _remove_dead(path: Path, owner: dict[str, Any]) -> None:
    """Remove the lock of an owner that is gone, and no other that came meanwhile.

    Of several processes, one alone can give it the name that only this lock can get.
    """
    digest = hashlib.sha256(repr(owner.get("token")).encode()).hexdigest()[:32]
    grave = path.with_name(f"{LOCK}.{digest}.dead.tmp")
    try:
        grave.mkdir()
    except FileExistsError:
        # Another is at it, or was killed while it was.
        with contextlib.suppress(OSError, UnsafeFileError):  # it may come and go meanwhile
            if seconds_silent(grave) > SECONDS_BETWEEN_SIGNS:
                grave.rmdir()
        time.sleep(_SECONDS_BETWEEN_LOOKS)
        return
    try:
        now = _read(path)
        # In the place of one that is gone the next may come before it is unlinked.
        if now is not _GONE and now.get("token") == owner.get("token"):
            path.unlink(missing_ok=True)
    finally:
        with contextlib.suppress(OSError):
            grave.rmdir()


def _beat(path: Path, token: str, lose: Callable[[UserError], object]) -> None:
    owner = _read(path)
    if owner.get("token") == token:
        with contextlib.suppress(OSError):
            give_sign(path)
    elif owner:
        lose(FolderInUseError(f"{_words(path.parent, owner)}: it took this one for dead"))
    elif is_gone(path.parent):
        lose(FolderGoneError(path.parent))
    elif is_gone(path):
        lose(UserError(f"{path}: somebody has removed it, so others may be at work here"))


def _words(root: Path, owner: dict[str, Any]) -> str:
    who = f"process {owner.get('pid', '?')} on {owner.get('host', '?')}"
    return visible(f"{root}: {who} is at work on it since {owner.get('since', '?')}")
