"""Writing files so that a reader, or a crash, never meets a half-written one; their names; JSON."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from typing import Any

from safe_files.files import NEW, folder_of, open_number

# Windows takes no more than 260 characters for a whole path, Linux no more than 255 bytes a name.
LONGEST_NAME = 100  # bytes

_REFUSED_SIGNS = re.compile(r'[<>:"/\\|?*\x00-\x1f]|[ .]+$')
# What `replacing` writes to.
_DRAFT = re.compile(r"\..+\.[0-9a-f]{16}\.tmp", re.DOTALL)
_DEVICE = re.compile(r"(con|prn|aux|nul|(con(in|out)\$)|(com|lpt)[0-9¹²³]) *(\.|$)", re.IGNORECASE)

# What happens to a file while it is written, of which the system does not say which it was.
DISK_ERRORS = frozenset({errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.EIO)})

# Folders of others above one's own, and file systems that flush no folder.
_CANNOT_SYNC = frozenset({errno.EACCES, errno.EPERM, errno.EINVAL, errno.ENOTSUP})

_SYNCED_AT_ONCE = 8

# Windows refuses to rename what a reader or a virus scanner has open, mostly for an instant.
_PAUSES = (0.05, 0.1, 0.2, 0.4, 0.8)  # seconds


def portable_name(name: str, longest: int = LONGEST_NAME) -> str:
    """The name, or one like it that every file system takes, of ``longest`` bytes at most."""
    plain = _REFUSED_SIGNS.sub("_", name) or "_"
    is_device = _DEVICE.match(plain) is not None
    if plain == name and not is_device and len(name.encode(errors="surrogatepass")) <= longest:
        return name
    if is_device:
        plain = plain.replace(".", "_")  # "nul.txt" is a device too
    digest = hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:8]
    kept = plain.encode(errors="replace")[: longest - len(digest) - 1]
    return f"{kept.decode(errors='ignore')}-{digest}"


def put_in_place(draft: Path, path: Path, folder: int | None = None) -> None:
    """Rename a file or folder to ``path`` in one step; names in the open ``folder``, if any."""
    for pause in (*(_PAUSES if sys.platform == "win32" else ()), None):
        try:
            os.replace(draft, path, src_dir_fd=folder, dst_dir_fd=folder)
            return
        except PermissionError:
            if pause is None:
                raise
            time.sleep(pause)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add ``path`` to errors of the disk that name no file."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_ERRORS and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[BufferedWriter]:
    """Give a file to write to, and let it appear as ``path`` once it is whole.

    Nobody meets a half-written file, whatever becomes of the process; a power cut may still take
    it. A link or pipe of that name is replaced and not written to. Names are those of the open
    folder, so that exchanging the folder meanwhile changes nothing.
    """
    # A name that could be guessed might be there already, as a link to another's file.
    name = f".{path.name}.{secrets.token_hex(8)}.tmp"
    with naming(path), folder_of(path) as (before, folder):
        draft = before / name
        try:
            with os.fdopen(os.open(draft, NEW, 0o666, dir_fd=folder), "wb") as file:
                yield file
            put_in_place(draft, before / path.name, folder)
        except OSError as error:
            if str(error.filename) == str(draft):  # of which nobody knows
                error.filename = str(path)
            raise
        finally:
            with contextlib.suppress(OSError):  # a disk that has become read-only refuses that too
                os.unlink(draft, dir_fd=folder)


def settle(folder: Path) -> None:
    """Wait until the disk has a folder and all that is in it."""
    sync(*files_below(folder), *(Path(parent) for parent, *_ in os.walk(folder)))


def sync(*paths: Path) -> None:
    """Wait until the disk has files and folders; faster for all at once."""
    from concurrent.futures import ThreadPoolExecutor  # half of what this module would take to load

    with ThreadPoolExecutor(_SYNCED_AT_ONCE) as pool:
        list(pool.map(_sync, paths))


def _sync(path: Path) -> None:
    is_folder = path.is_dir()
    if sys.platform == "win32" and is_folder:  # it keeps names in a journal, and flushes no folder
        return
    try:
        # Windows flushes only what may be written.
        access = os.O_RDWR if sys.platform == "win32" else os.O_RDONLY
        number = os.open(path, access) if is_folder else open_number(path, access)
        try:
            os.fsync(number)
        finally:
            os.close(number)
    except OSError as error:
        if not is_folder or error.errno not in _CANNOT_SYNC:
            raise


def files_below(folder: Path) -> list[Path]:
    """The regular files in a folder and in those inside it; no link is followed or counts."""
    paths = (Path(parent, name) for parent, _, names in os.walk(folder) for name in names)
    return [path for path in paths if path.is_file() and not path.is_symlink()]


def drafts_in(folder: Path) -> list[Path]:
    """The files in a folder, and in those inside it, that `replacing` has begun to write."""
    return [path for path in files_below(folder) if _DRAFT.fullmatch(path.name)]


def write_text(path: Path, text: str) -> None:
    """Replace the file at ``path`` by ``text``, byte for byte the same on every system."""
    with replacing(path) as file:
        file.write(text.encode())


def write_json(path: Path, data: Any) -> None:
    """Replace the file at ``path`` by ``data`` as indented JSON; nan is null there."""
    with replacing(path) as file:
        file.write(f"{json_text(data, indent=2)}\n".encode())


# A number in JSON's grammar, beyond what a double holds: read as infinity, by Python's reader and
# by browsers.
_INFINITY = "1e999"


def plain(value: Any, infinities: Mapping[float, str] | None = None) -> Any:
    """The value as JSON gives it back, nan as None; infinities as the texts given for them."""
    match value:
        case Mapping():
            keys = [key if isinstance(key, str) else json.dumps(plain(key)) for key in value]
            return dict(zip(keys, (plain(v, infinities) for v in value.values()), strict=True))
        case list() | tuple():
            return [plain(item, infinities) for item in value]
        case float():
            return None if math.isnan(value) else (infinities or {}).get(value, float(value))
        case None | bool() | int() | str():
            return value
        case _:
            import numpy as np  # where there is such a value; `--help` is there without

            if not isinstance(value, np.generic | np.ndarray):
                raise TypeError(f"a {type(value).__name__} has no place in JSON")
            return plain(value.tolist(), infinities)


def json_text(value: Any, indent: int | None = None) -> str:
    """The value as JSON, with infinity as a number that is too large."""
    # Nobody can have put these into a text of his.
    tokens = {sign: secrets.token_hex(16) for sign in (math.inf, -math.inf)}
    text = json.dumps(plain(value, tokens), indent=indent, allow_nan=False)
    for sign, token in tokens.items():
        text = text.replace(f'"{token}"', _INFINITY if sign > 0 else f"-{_INFINITY}")
    return text
