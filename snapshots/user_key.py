"""A secret of this user's on this machine, by which a program knows again what it has written."""

from __future__ import annotations

import os
import secrets
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
    if not path.exists():
        _make(path)
    key = path.read_bytes()
    if len(key) != KEY_BYTES:
        raise OSError(f"{path} is damaged: remove it")
    if sys.platform != "win32":
        status = path.stat()
        if status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise OSError(f"{path} must be the user's own, and of mode 600")
    return key


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
