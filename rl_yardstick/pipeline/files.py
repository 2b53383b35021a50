"""Files: read with a limit, written beside their name and renamed into place."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_TEXT = 10_000_000  # bytes of a settings file
MAX_ARRAYS = 1 << 31  # bytes of an archive of arrays
LONGEST_NAME = 100  # bytes; Windows limits a whole path to 260 characters

_REFUSED_SIGNS = re.compile(r'[<>:"/\\|?*\x00-\x1f]|[ .]+$')
_DEVICE = re.compile(r"^(con|prn|aux|nul|com\d|lpt\d) *(\.|$)", re.IGNORECASE)  # of Windows


def portable_name(name: str, longest: int = LONGEST_NAME) -> str:
    """The name, or a similar one of at most ``longest`` bytes that is valid on every system."""
    plain = _DEVICE.sub(r"\1_", _REFUSED_SIGNS.sub("_", name)) or "_"
    if plain == name and len(name.encode()) <= longest:
        return name
    digest = hashlib.sha256(name.encode(errors="replace")).hexdigest()[:8]
    kept = plain.encode(errors="replace")[: longest - len(digest) - 1]
    return f"{kept.decode(errors='ignore')}-{digest}"


def read_bytes(path: Path, limit: int = MAX_TEXT) -> bytes:
    """The content of a regular file of at most ``limit`` bytes.

    Raises:
        UserError: if the file is missing, unreadable, too large, or not a regular file.
    """
    try:
        # Without O_NONBLOCK, opening a named pipe waits for somebody who writes to it.
        number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(number, "rb") as file:
            status = os.fstat(number)
            if not stat.S_ISREG(status.st_mode):
                raise UserError(f"{path} is not a regular file")
            if status.st_size > limit:
                raise UserError(f"{path}: {status.st_size:,} bytes, the limit is {limit:,}")
            return file.read(status.st_size)
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
    try:
        return json.loads(read_text(path, limit))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is no valid JSON: {error}") from error


def read_arrays(
    path: Path, shapes: Mapping[str, str], optional: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Arrays of numbers in a NumPy archive, which is read as data.

    Args:
        path: the archive.
        shapes: names of arrays, and of their axes: axes of one name must have the same length.
        optional: names of arrays that may be missing.
    """
    from numpy.lib.format import read_array

    from rl_yardstick.safe_files.files import read_members

    found: dict[str, NDArray[Any]] = {}
    lengths: dict[str, int] = {}
    try:
        members = read_members(read_bytes(path, MAX_ARRAYS))
        for name, axes in shapes.items():
            if name in optional and f"{name}.npy" not in members:
                continue
            content = members[f"{name}.npy"]
            found[name] = read_array(io.BytesIO(content), allow_pickle=False)
            sizes = zip(axes.split(), found[name].shape, strict=True)
            wanted = [int(a) if a.isdigit() else lengths.setdefault(a, n) for a, n in sizes]
            if found[name].dtype.kind not in "biuf" or tuple(wanted) != found[name].shape:
                raise ValueError(f"{name} has another shape or kind")
    except (ValueError, LookupError, OverflowError, MemoryError) as error:
        raise UserError(f"{path} is damaged: {error}") from error
    return found


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside ``path`` to write to, which then takes its place; the suffix is the same.

    This is the only way in which a file gets its name, so files with their names are whole.
    """
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
            return plain(value.tolist(), infinities)  # of NumPy


def json_text(value: Any, indent: int | None = None) -> str:
    """The value as JSON, with infinity as a number beyond the range of doubles."""
    # Random texts, which no value can contain.
    tokens = {sign: secrets.token_hex(16) for sign in (math.inf, -math.inf)}
    text = json.dumps(plain(value, tokens), indent=indent, allow_nan=False)
    for sign, token in tokens.items():
        text = text.replace(f'"{token}"', _INFINITY if sign > 0 else f"-{_INFINITY}")
    return text
