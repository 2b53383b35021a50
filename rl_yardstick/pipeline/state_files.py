"""Reads and writes files of training states, signed with a key of this user.

| bytes | |
|---|---|
| 16 | `MAGIC` |
| 32 | HMAC-SHA256 of `MAGIC`, the length and the header, under the user's key |
| 8 | length of the header, little-endian |
| | the header, JSON: the note, places in the training, length and SHA-256 of each part |
| | the parts: the pickle, then memory of arrays and tensors, each without the zeros at its end |

A pickle can run any code when it is loaded. So the header's HMAC and the SHA-256 of each part are
checked first, and exactly the checked bytes are unpickled. A run keeps its newest two states, so
that one is complete.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import stat
import sys
from collections.abc import Callable
from dataclasses import dataclass
from io import BufferedReader, BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from rl_yardstick.pipeline.digests import source_digest
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import replacing, sync
from rl_yardstick.pipeline.runs import state_file, state_files
from rl_yardstick.pipeline.states import Pickled, Place
from rl_yardstick.safe_files.files import NO_LIMIT, UnsafeFileError, opened

APPLICATION = "yardstick"
SOURCES = "sources"
MAGIC = b"training state 4"
KEY_BYTES = 32
LONGEST_HEADER = 1 << 30  # bytes
_PIECE = 1 << 20  # bytes


class BadStateError(Exception):
    """A file has no state, a damaged state, or one that was signed with another key."""


@dataclass(frozen=True)
class SavedState:
    """A state from a file with a valid signature; not unpickled yet."""

    content: Pickled  # the training
    note: dict[str, Any]  # further data

    @property
    def is_of_these_sources(self) -> bool:
        """Whether Yardstick's code is unchanged since the state was saved."""
        return self.note.get(SOURCES) == source_digest()


def save_state(folder: Path, number: int, content: Pickled, note: dict[str, Any]) -> None:
    """Write a state with its number, in place of the state before the last one."""
    key = state_key()
    folder.mkdir(exist_ok=True)
    with replacing(state_file(folder, number)) as file:
        write_state(file, content, {**note, "number": number, SOURCES: source_digest()}, key)
    sync(folder)


def newest_state(folder: Path, tell: Callable[[str], object]) -> SavedState | None:
    """The newest valid state, or None; reports a damaged one, and raises if there is no other."""
    key, found, reasons = state_key(), [], []
    for path in filter(Path.is_file, state_files(folder)):
        try:
            with opened(path, NO_LIMIT) as file:
                found.append(read_state(file, key))
        except FileNotFoundError:
            continue
        except (OSError, UnsafeFileError, BadStateError, MemoryError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            reasons.append(f"{path}: {str(reason).removeprefix(f'{path} ')}")
    if reasons and not found:
        raise UserError(f"{reasons[0]}; remove {folder} to begin the run again")
    for reason in reasons:
        tell(f"{reason}; the state before it is taken")
    return max(found, key=lambda state: int(state.note["number"]), default=None)


def write_state(file: BufferedWriter, content: Pickled, note: dict[str, Any], key: bytes) -> None:
    """Write a state, with a note as JSON, and flush it to disk."""
    memories = [(_as_array(memory), isinstance(memory, th.Tensor)) for memory in content.memories]
    parts = [np.frombuffer(content.pickled, np.uint8)]
    parts += [_without_zeros(memory) for memory, _ in memories]
    sizes = [(len(parts[0]), False), *((len(memory), is_tensor) for memory, is_tensor in memories)]
    header = {
        "note": note,
        "places": [[place.steps, place.class_name] for place in content.places],
        "python": sys.implementation.cache_tag if content.has_code else None,
        "parts": [
            [len(part), hashlib.sha256(part.data).hexdigest(), *size]
            for part, size in zip(parts, sizes, strict=True)
        ],
    }
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    file.write(MAGIC + _signature(key, text) + _length(text) + text)
    for part in parts:
        file.write(part.data)
    file.flush()
    os.fsync(file.fileno())


def read_state(file: BufferedReader, key: bytes) -> SavedState:
    """Read a state and check its signature, without unpickling anything."""
    if file.read(len(MAGIC)) != MAGIC:
        raise BadStateError("it is no state, or one of another version of Yardstick")
    signature, length = file.read(hashlib.sha256().digest_size), file.read(8)
    most = min(os.fstat(file.fileno()).st_size, LONGEST_HEADER)
    text = file.read(min(int.from_bytes(length, "little"), most))
    is_ours = hmac.compare_digest(signature, _signature(key, text)) and length == _length(text)
    if not is_ours:
        raise BadStateError(
            "it is damaged, or another user or machine made it, or the key was replaced"
        )
    # From here on, the header is authentic, and describes each part.
    header = json.loads(text)
    if header["python"] not in (None, sys.implementation.cache_tag):
        raise BadStateError(f"functions in it were compiled by {header['python']}, another Python")
    parts = [_part(file, *part) for part in header["parts"]]
    if file.read(1):
        raise BadStateError("it is damaged: bytes follow its end")
    places = [Place(tuple(steps), name) for steps, name in header["places"]]
    return SavedState(Pickled(_as_array(parts[0]).data, places, parts[1:]), header["note"])


def _part(
    file: BufferedReader, n_bytes: int, digest: str, size: int, is_tensor: bool
) -> NDArray[np.uint8] | th.Tensor:
    """Read a part of a file into memory of its library."""
    part = th.zeros(size, dtype=th.uint8) if is_tensor else np.zeros(size, np.uint8)
    content = _as_array(part)[:n_bytes]
    n_read = file.readinto(content.data)
    if n_read != n_bytes or hashlib.sha256(content.data).hexdigest() != digest:
        raise BadStateError("it is damaged")
    return part


def _as_array(memory: NDArray[np.uint8] | th.Tensor) -> NDArray[np.uint8]:
    return memory.numpy() if isinstance(memory, th.Tensor) else memory


def _length(text: bytes) -> bytes:
    return len(text).to_bytes(8, "little")


def _signature(key: bytes, text: bytes) -> bytes:
    return hmac.digest(key, MAGIC + _length(text) + text, "sha256")


def _without_zeros(content: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The bytes without trailing zeros, which a buffer has until it is full."""
    for begin in reversed(range(0, len(content), _PIECE)):
        piece = content[begin : begin + _PIECE]
        if piece.any():
            return content[: begin + len(piece.tobytes().rstrip(b"\0"))]
    return content[:0]


def state_key() -> bytes:
    """The key that signs this user's states."""
    try:
        return user_key(APPLICATION)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or error
        raise UserError(f"the key to saved states: {place}{reason}") from error


def configuration_folder(application: str) -> Path:
    """The folder of an application's user data; it need not exist."""
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
    """The user's key for an application; made at the first call, readable only by the user."""
    path = configuration_folder(application) / "snapshots.key"
    if not os.path.lexists(path):
        _make(path)
    # Does not wait, for example for a pipe; checks the same file that it reads.
    number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        status = os.fstat(number)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(f"{path} is no regular file: remove it")
        if sys.platform != "win32" and (status.st_uid != os.geteuid() or status.st_mode & 0o077):
            raise OSError(f"{path} must be the user's own, and of mode 600")
        key = os.read(number, KEY_BYTES + 1)
    finally:
        os.close(number)
    if len(key) != KEY_BYTES:
        raise OSError(f"{path} is damaged: remove it")
    return key


def _make(path: Path) -> None:
    """Write a new key; if two processes do so at once, the first key stays."""
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
