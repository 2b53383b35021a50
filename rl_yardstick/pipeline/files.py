"""Files: read with a limit, written beside their name and renamed into place."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import secrets
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rl_yardstick.pipeline.errors import UserError, as_user_error
from rl_yardstick.safe_files.files import UnsafeFileError, content_of, read_members

MAX_TEXT = 10_000_000  # bytes of a settings file
MAX_TABLE = 1 << 31  # bytes of a table, or of an archive of arrays
LONGEST_NAME = 100  # bytes; Windows limits a whole path to 260 characters

_REFUSED_SIGNS = re.compile(r'[<>:"/\\|?*\x00-\x1f]|[ .]+$')
_DEVICE = re.compile(r"^(con|prn|aux|nul|com\d|lpt\d) *(\.|$)", re.IGNORECASE)  # of Windows


def portable_name(name: str) -> str:
    """The name, or a similar one of at most `LONGEST_NAME` bytes that is valid on every system."""
    plain = _DEVICE.sub(r"\1_", _REFUSED_SIGNS.sub("_", name)) or "_"
    if plain == name and len(name.encode()) <= LONGEST_NAME:
        return name
    digest = hashlib.sha256(name.encode(errors="replace")).hexdigest()[:8]
    kept = plain.encode(errors="replace")[: LONGEST_NAME - len(digest) - 1]
    return f"{kept.decode(errors='ignore')}-{digest}"


def read_bytes(path: Path, limit: int = MAX_TEXT) -> bytes:
    """The content of a regular file of at most ``limit`` bytes; UserError if it is none."""
    try:
        return content_of(path, limit)
    except UnsafeFileError as error:
        raise UserError(str(error)) from error
    except OSError as error:
        raise UserError(f"{path}: {(error.strerror or str(error)).lower()}") from error


def read_text(path: Path, limit: int = MAX_TEXT) -> str:
    """The content of a UTF-8 text file."""
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no UTF-8 text: byte {error.start}") from error


def read_json(path: Path, limit: int = MAX_TEXT) -> Any:
    """The content of a JSON file."""
    with as_user_error(f"{path} is no valid JSON", ValueError, RecursionError):
        return json.loads(read_text(path, limit))


def read_arrays(
    path: Path, shapes: Mapping[str, str], optional: Collection[str] = ()
) -> dict[str, Any]:
    """Arrays of numbers in a NumPy archive, which is read as data; the ``optional`` may be missing.

    ``shapes`` has the names of arrays and of their axes: those of one name have the same length.
    """
    from numpy.lib.format import read_array

    found: dict[str, Any] = {}
    lengths: dict[str, int] = {}
    with as_user_error(f"{path} is damaged", ValueError, LookupError, OverflowError, MemoryError):
        members = read_members(read_bytes(path, MAX_TABLE))
        for name in [n for n in shapes if n not in optional or f"{n}.npy" in members]:
            array = read_array(io.BytesIO(members[f"{name}.npy"]), allow_pickle=False)
            sizes = zip(shapes[name].split(), array.shape, strict=True)
            wanted = [int(a) if a.isdigit() else lengths.setdefault(a, n) for a, n in sizes]
            if array.dtype.kind not in "biuf" or tuple(wanted) != array.shape:
                raise ValueError(f"{name} has another shape or kind")
            found[name] = array
    return found


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside ``path`` to write to, which then takes its place; the suffix is the same.

    This is the only way in which a file gets its name, so files with their names are whole. Only
    what is no regular file, such as /dev/stdout, is written into directly.
    """
    if path.is_symlink() or (path.exists() and not path.is_file()):
        yield path
        return
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield beside
        beside.replace(path)
    except BaseException as error:
        # Writing to a full disk names no file, and the name beside is an internal one.
        if isinstance(error, OSError) and error.filename in (None, str(beside)):
            error.filename = str(path)
        beside.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all, with the same bytes on every system."""
    with replacing(path) as beside:
        beside.write_bytes(text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` as indented JSON; nan becomes null."""
    write_text(path, f"{json_text(data, indent=2)}\n")


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
        case Path():
            return str(value)
        case _:
            return plain(value.tolist(), infinities)  # of NumPy


def json_text(value: Any, indent: int | None = None) -> str:
    """The value as JSON, with infinity as 1e999, which Python and browsers read as infinity."""
    token = secrets.token_hex(16)  # which no value can contain
    signs = {math.inf: f"+{token}", -math.inf: f"-{token}"}
    text = json.dumps(plain(value, signs), indent=indent, allow_nan=False)
    return text.replace(f'"+{token}"', "1e999").replace(f'"-{token}"', "-1e999")
