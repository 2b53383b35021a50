"""Locks a study or a run for one process at a time, by a lock file that names its owner.

The lock file is created atomically, as a link to a finished file; that works on network folders
too. Its owner touches it every five seconds. Times are those of the folder's clock, which all
machines share. On the owner's machine, we check whether its process exists; on other machines, an
owner counts as dead after a minute without a touch.

Process numbers repeat: after a reboot, in each container and on each machine. So on Linux the lock
names a process by its number, its start in kernel ticks, the boot id and the namespace.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rl_yardstick.pipeline.digests import LOCK
from rl_yardstick.pipeline.errors import UserError, visible
from rl_yardstick.pipeline.files import NEW
from rl_yardstick.pipeline.signs_of_life import Heartbeat
from rl_yardstick.safe_files.files import NO_LIMIT, UnsafeFileError, opened, read_file

_BOOT = "/proc/sys/kernel/random/boot_id"
_MACHINES = ("/etc/machine-id", "/var/lib/dbus/machine-id")
_STATE, _BEGAN = 0, 19  # fields in /proc/<pid>/stat, counted after the program's name
_ENDED = "ZXx"

SECONDS_BETWEEN_SIGNS = 5.0
SECONDS_OF_SILENCE = 60.0
_SECONDS_BETWEEN_LOOKS = 0.2
_LARGEST = 10_000  # bytes
_GONE: dict[str, Any] = {}  # compared by identity

# Short-lived temporary files, of this module and of `pipeline.files.replacing`.
_FOR_AN_INSTANT = re.compile(r"\..*[0-9a-f]{16}(\.dead)?\.tmp")
_SECONDS_OF_AN_INSTANT = 5.0


def mark() -> dict[str, Any]:
    """The identity of this process as JSON; fields that the platform does not report are None."""
    pid, machine, namespace = os.getpid(), _first_line(*_MACHINES), None
    with contextlib.suppress(OSError):
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115  # it leads to no path
    return {
        "pid": pid,
        "host": platform.node(),
        # Hashed, because the machine id is confidential.
        "machine": machine and hashlib.sha256(f"yardstick {machine}".encode()).hexdigest()[:32],
        "boot": _first_line(_BOOT),
        "namespace": namespace,
        "began": _ticks_at_begin(pid),
    }


def is_alive(record: object) -> bool | None:
    """Whether the process of a `mark` still exists.

    None if this cannot be known: on another host or container, or if the record is no mark.
    """
    pid = record.get("pid") if isinstance(record, Mapping) else None
    if not isinstance(record, Mapping) or type(pid) is not int or not 0 < pid < 2**31:
        return None
    own, is_same_host = mark(), record.get("host") == platform.node()
    if record.get("boot") != own["boot"]:
        is_same_machine = own["machine"] is not None and record.get("machine") == own["machine"]
        is_known = None not in (own["boot"], record.get("boot"))
        return False if is_known and is_same_host and is_same_machine else None
    if own["boot"] is None:  # the system does not report it
        return _has_process(pid) if is_same_host else None
    if record.get("namespace") != own["namespace"]:
        return None
    began = _ticks_at_begin(pid)
    if began is None or record.get("began") is None:  # process gone, or hidden from this user
        return _has_process(pid)
    return began == record.get("began")


def _first_line(*files: str) -> str | None:
    for file in files:
        with contextlib.suppress(OSError):
            text = Path(file).read_text(encoding="utf-8", errors="replace")
            if line := text.partition("\n")[0].strip():
                return line
    return None


def _ticks_at_begin(pid: int) -> int | None:
    """The start of the process in kernel ticks since the boot; -1 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # The program's name is in brackets, and may contain brackets.
    fields = text.rpartition(")")[2].split()
    if len(fields) <= _BEGAN:
        return None
    return -1 if fields[_STATE] in _ENDED else int(fields[_BEGAN])


if sys.platform == "win32":
    import _winapi

    def _has_process(pid: int) -> bool:
        # On Windows, `os.kill` would end the process or send Ctrl-C, whatever the signal.
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

    def _has_process(pid: int) -> bool:
        try:
            os.kill(pid, 0)  # noqa: TID251  # not on Windows
        except ProcessLookupError:
            return False
        except PermissionError:
            pass
        return True


def give_sign(path: Path) -> None:
    """Touch a file or folder as a heartbeat of its owner."""
    # Without a time, so that a network folder uses the clock of its server.
    os.utime(path, follow_symlinks=os.utime not in os.supports_follow_symlinks)


def seconds_silent(path: Path) -> float:
    """Seconds since a path was last touched, by the folder's clock."""
    probe = path.parent / f".{secrets.token_hex(8)}.tmp"
    try:
        probe.touch()
        now = probe.stat().st_mtime
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return now - last_sign(path)


def last_sign(path: Path) -> float:
    """When a path was last touched, by the folder's clock."""
    if path.is_dir():
        return path.stat().st_mtime
    # Network folders cache file attributes, but opening the file refreshes them.
    with opened(path, NO_LIMIT) as file:
        return os.fstat(file.fileno()).st_mtime


def remove_remains(root: Path) -> None:
    """Remove temporary files of killed processes from a folder and its direct subfolders."""
    for folder in (root, *(root / name for name in _names_in(root))):
        for name in filter(_FOR_AN_INSTANT.fullmatch, _names_in(folder)):
            path = folder / name
            with contextlib.suppress(OSError, UnsafeFileError):
                if seconds_silent(path) > _SECONDS_OF_AN_INSTANT:
                    if path.is_dir():
                        path.rmdir()
                    else:
                        path.unlink()


def _names_in(folder: Path) -> list[str]:
    """The names in a folder; empty if the folder does not exist."""
    with contextlib.suppress(OSError):
        return [path.name for path in folder.iterdir()]
    return []


class FolderInUseError(UserError):
    """Another process has locked the folder."""


class FolderGoneError(UserError):
    """A folder in use by this process was removed or renamed."""

    def __init__(self, root: Path) -> None:
        super().__init__(f"{root}: this folder is gone: somebody has removed or renamed it")


def is_gone(path: Path) -> bool:
    """Whether the file or folder does not exist; False if it cannot be reached."""
    try:
        return not path.exists()
    except OSError:
        return False


@contextmanager
def told_if_gone(root: Path) -> Iterator[None]:
    """Raise `FolderGoneError` for errors in the ``with`` statement if the folder is gone."""
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
    """Lock a folder for this process inside the ``with`` statement.

    Makes the folder, and removes it again if it stays empty. ``on_loss`` is called in another
    thread if the lock is lost, and must end the work: another process has considered this one
    dead, or somebody has removed the folder. ``say`` gets the reason for a long wait.
    """
    lost: list[UserError] = []

    def lose(error: UserError) -> None:
        if not lost:
            lost.append(error)
            on_loss()

    made = [folder for folder in (root, *root.parents) if not folder.exists()]  # innermost first
    root.mkdir(parents=True, exist_ok=True)
    path, token = root / LOCK, secrets.token_hex(16)
    try:
        _take(path, token, say)
        remove_remains(root)
        heart = Heartbeat(lambda: _beat(path, token, lose), SECONDS_BETWEEN_SIGNS)
        heart.start()
        try:
            yield
        except KeyboardInterrupt as stop:
            if lost:  # the loss of the lock caused it
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


def _take(path: Path, token: str, say: Callable[[str], object]) -> None:
    own = {**mark(), "token": token, "since": time.strftime("%Y-%m-%d %H:%M:%S")}
    while not _appears(path, json.dumps(own)):
        owner = _read(path)
        if _is_at_work(path, owner, say):
            raise FolderInUseError(_words(path.parent, owner))
        _remove_dead(path, owner)


def _appears(path: Path, content: str) -> bool:
    """Create the lock atomically; False if it exists already."""
    draft = path.with_name(f"{LOCK}.{secrets.token_hex(8)}.tmp")
    try:
        with os.fdopen(os.open(draft, NEW), "wb") as file:
            file.write(content.encode())
        os.link(draft, path)
    except FileExistsError:
        return False
    except FileNotFoundError:
        if path.parent.is_dir():
            return False  # the lock's owner has removed the temporary file
        raise
    except OSError:  # a file system without links: the lock is briefly empty
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(content)
        except FileExistsError:
            return False
        except OSError:  # the disk is full, or read-only
            with contextlib.suppress(OSError):
                path.unlink()
            raise
    finally:
        with contextlib.suppress(OSError):
            draft.unlink()
    return True


def _read(path: Path) -> dict[str, Any]:
    """Read a lock; empty if it is damaged, `_GONE` if it does not exist."""
    try:
        owner = json.loads(read_file(path, _LARGEST))
    except FileNotFoundError:
        return _GONE
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _is_at_work(path: Path, owner: dict[str, Any], say: Callable[[str], object]) -> bool:
    """Whether the owner of a lock is alive; waits for a heartbeat from another machine."""
    alive = is_alive(owner)
    if alive is not None:
        return alive
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
        pass  # the owner has just ended
    return False


def _remove_dead(path: Path, owner: dict[str, Any]) -> None:
    """Remove a dead owner's lock; a folder named by its digest admits one process at a time."""
    digest = hashlib.sha256(repr(owner.get("token")).encode()).hexdigest()[:32]
    grave = path.with_name(f"{LOCK}.{digest}.dead.tmp")
    try:
        grave.mkdir()
    except FileExistsError:
        # Another process is removing the lock, or was killed while it did.
        with contextlib.suppress(OSError, UnsafeFileError):  # it may disappear meanwhile
            if seconds_silent(grave) > SECONDS_BETWEEN_SIGNS:
                grave.rmdir()
        time.sleep(_SECONDS_BETWEEN_LOOKS)
        return
    try:
        now = _read(path)
        # A new owner's lock may have replaced the dead one by now.
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
        lose(FolderInUseError(f"{_words(path.parent, owner)}: it has taken over the lock"))
    elif is_gone(path.parent):
        lose(FolderGoneError(path.parent))
    elif is_gone(path):
        lose(UserError(f"{path}: somebody has removed it, so others may be at work here"))


def _words(root: Path, owner: dict[str, Any]) -> str:
    who = f"process {owner.get('pid', '?')} on {owner.get('host', '?')}"
    return visible(f"{root}: {who} is at work on it since {owner.get('since', '?')}")
