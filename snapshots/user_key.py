"""A secret of this user's on this machine, by which a program knows again what it has written."""

from __future__ import annotations

import os
import secrets
import stat
import sys
from pathlib import Path

KEY_BYTES = 32


def configuration_folder(application: str) -> Path:
    """Where an application keeps what belongs to the user; the folder need not be there.

    Raises:
        OSError: if the user has no home.
    """
    try:
        home = Path.home()
    except RuntimeError as error:
        raise FileNotFoundError("the user has no home folder") from error
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA") or home / "AppData" / "Roaming") / application
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / application
    return Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / application


def user_key(application: str) -> bytes:
    """The user's key for an application; made at the first call, readable by the user alone.

    Raises:
        OSError: if there is none and none can be made, or others may read or change it.
    """
    path = configuration_folder(application) / "snapshots.key"
    if not os.path.lexists(path):
        _make(path)
    # Without waiting, as for a pipe; what is checked is what is read.
    number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check(os.fstat(number), path)
        key = os.read(number, KEY_BYTES + 1)
    finally:
        os.close(number)
    if len(key) != KEY_BYTES:
        raise OSError(f"{path} is damaged: remove it")
    return key


def _check(status: os.stat_result, path: Path) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f"{path} is no regular file: remove it")
    if sys.platform != "win32" and (status.st_uid != os.geteuid() or status.st_mode & 0o077):
        raise OSError(f"{path} must be the user's own, and of mode 600")


def _make(path: Path) -> None:
    """Write a new key; where two processes do so at once, the first one's stays."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    draft = path.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:  # noqa: PTH123
            file.write(secrets.token_bytes(KEY_BYTES))
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(draft, path)
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
