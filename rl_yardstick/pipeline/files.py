"""Writes files atomically, makes portable file names, and converts values to JSON."""

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

# Fails if the name exists, even as a link.
NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)

# Windows limits a whole path to 260 characters, Linux a name to 255 bytes.
LONGEST_NAME = 100  # bytes

_REFUSED_SIGNS = re.compile(r'[<>:"/\\|?*\x00-\x1f]|[ .]+$')
# Names of the temporary files of `replacing`.
_DRAFT = re.compile(r"\..+\.[0-9a-f]{16}\.tmp", re.DOTALL)
_DEVICE = re.compile(r"(con|prn|aux|nul|(con(in|out)\$)|(com|lpt)[0-9¹²³]) *(\.|$)", re.IGNORECASE)

# Errors while writing for which the system does not name the file.
DISK_ERRORS = frozenset({errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.EIO)})

# Errors for parent folders of other users, and for file systems that cannot flush folders.
_CANNOT_SYNC = frozenset({errno.EACCES, errno.EPERM, errno.EINVAL, errno.ENOTSUP})

_SYNCED_AT_ONCE = 8

# Windows refuses to rename a file that a reader or virus scanner has open, mostly briefly.
_PAUSES = (0.05, 0.1, 0.2, 0.4, 0.8)  # seconds


def portable_name(name: str, longest: int = LONGEST_NAME) -> str:
    """The name, or a similar one of at most ``longest`` bytes that is valid on every system."""
    plain = _REFUSED_SIGNS.sub("_", name) or "_"
    is_device = _DEVICE.match(plain) is not None
    if plain == name and not is_device and len(name.encode(errors="surrogatepass")) <= longest:
        return name
    if is_device:
        plain = plain.replace(".", "_")  # "nul.txt" is a device name too
    digest = hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:8]
    kept = plain.encode(errors="replace")[: longest - len(digest) - 1]
    return f"{kept.decode(errors='ignore')}-{digest}"


def put_in_place(draft: Path, path: Path) -> None:
    """Rename a file or folder to ``path`` atomically."""
    for pause in (*(_PAUSES if sys.platform == "win32" else ()), None):
        try:
            draft.replace(path)
            return
        except PermissionError:
            if pause is None:
                raise
            time.sleep(pause)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add ``path`` to OSErrors that name no file."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_ERRORS and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[BufferedWriter]:
    """Open a temporary file for writing, and rename it to ``path`` once it is complete.

    Readers never see a half-written file, even if the process dies; a power cut may still lose the
    file. A link or pipe at ``path`` is replaced, not written to.
    """
    # A predictable name might exist already, as a link to another user's file.
    name = f".{path.name}.{secrets.token_hex(8)}.tmp"
    draft = path.with_name(name)
    with naming(path):
        try:
            with os.fdopen(os.open(draft, NEW, 0o666), "wb") as file:
                yield file
            put_in_place(draft, path)
        except OSError as error:
            if str(error.filename) == str(draft):  # an internal name
                error.filename = str(path)
            raise
        finally:
            with contextlib.suppress(OSError):  # fails on a disk that has become read-only
                draft.unlink()


def settle(folder: Path) -> None:
    """Flush a folder and all its contents to disk."""
    sync(*files_below(folder), *(Path(parent) for parent, *_ in os.walk(folder)))


def sync(*paths: Path) -> None:
    """Flush files and folders to disk, several at once."""
    from concurrent.futures import ThreadPoolExecutor  # half of this module's import time

    with ThreadPoolExecutor(_SYNCED_AT_ONCE) as pool:
        list(pool.map(_sync, paths))


def _sync(path: Path) -> None:
    is_folder = path.is_dir()
    if sys.platform == "win32" and is_folder:  # it journals names, and cannot flush folders
        return
    try:
        # Windows flushes only files that are open for writing.
        access = os.O_RDWR if sys.platform == "win32" else os.O_RDONLY
        number = os.open(path, access)
        try:
            os.fsync(number)
        finally:
            os.close(number)
    except OSError as error:
        if not is_folder or error.errno not in _CANNOT_SYNC:
            raise


def files_below(folder: Path) -> list[Path]:
    """The regular files in a folder and its subfolders, without links."""
    paths = (Path(parent, name) for parent, _, names in os.walk(folder) for name in names)
    return [path for path in paths if path.is_file() and not path.is_symlink()]


def drafts_in(folder: Path) -> list[Path]:
    """The temporary files of `replacing` in a folder and its subfolders."""
    return [path for path in files_below(folder) if _DRAFT.fullmatch(path.name)]


def write_text(path: Path, text: str) -> None:
    """Replace the file at ``path`` by ``text``, with the same bytes on every system."""
    with replacing(path) as file:
        file.write(text.encode())


def write_json(path: Path, data: Any) -> None:
    """Replace the file at ``path`` by ``data`` as indented JSON; nan becomes null."""
    with replacing(path) as file:
        file.write(f"{json_text(data, indent=2)}\n".encode())


# A valid JSON number that is too large for a double: Python and browsers read it as infinity.
_INFINITY = "1e999"


def plain(value: Any, infinities: Mapping[float, str] | None = None) -> Any:
    """The value as JSON types: nan becomes None, infinities become the given texts."""
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
            import numpy as np  # only here: `--help` does not need NumPy

            if not isinstance(value, np.generic | np.ndarray):
                raise TypeError(f"a {type(value).__name__} has no place in JSON")
            return plain(value.tolist(), infinities)


def json_text(value: Any, indent: int | None = None) -> str:
    """The value as JSON, with infinity as a number beyond the range of doubles."""
    # Random texts, which no value can contain.
    tokens = {sign: secrets.token_hex(16) for sign in (math.inf, -math.inf)}
    text = json.dumps(plain(value, tokens), indent=indent, allow_nan=False)
    for sign, token in tokens.items():
        text = text.replace(f'"{token}"', _INFINITY if sign > 0 else f"-{_INFINITY}")
    return text
