"""Snapshots on disk: a line of JSON and the bytes of arrays, under a code that only a key can make.

| bytes | |
|---|---|
| 16 | `MAGIC` |
| 32 | HMAC-SHA256 of all that follows, under the key |
| 8 | length of the JSON, little-endian |
| | the JSON: roots, nodes, a table of arrays, and what the caller adds |
| | the arrays, one after the other, each without the zeros at its end |

The code is checked before anything else is looked at: a file that was not written under the same
key is not read.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
from io import BufferedReader, BufferedWriter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snapshots.recording import Snapshot

MAGIC = b"snapshot 3\n".ljust(16, b"\0")
LONGEST_TREE = 1 << 30  # bytes
_PIECE = 1 << 20  # bytes
_CODE_AT = len(MAGIC)
_CODE_BYTES = hashlib.sha256().digest_size


class BadSnapshotError(Exception):
    """A file holds no snapshot, a damaged one, or one that was made under another key."""


def write_snapshot(
    file: BufferedWriter, snapshot: Snapshot, note: dict[str, Any], key: bytes
) -> None:
    """Write a snapshot and flush it to the disk.

    Args:
        file: where to, open and empty.
        snapshot: the record.
        note: what else the file is to say, as JSON.
        key: what makes the code.
    """
    parts = [_content(array) for array in snapshot.arrays]
    table = [
        {
            "dtype": np.lib.format.dtype_to_descr(array.dtype),
            "shape": array.shape,
            "bytes": part.nbytes,
        }
        for array, part in zip(snapshot.arrays, parts, strict=True)
    ]
    tree = {"note": note, "roots": snapshot.roots, "nodes": snapshot.nodes, "arrays": table}
    text = json.dumps(tree, allow_nan=False, separators=(",", ":")).encode()
    code = hmac.new(key, digestmod="sha256")
    file.write(MAGIC)
    file.write(bytes(_CODE_BYTES))
    contents: list[bytes | memoryview[Any]] = [part.data for part in parts if part.nbytes]
    for content in (len(text).to_bytes(8, "little"), text, *contents):
        code.update(content)
        file.write(content)
    file.seek(_CODE_AT)
    file.write(code.digest())
    file.flush()
    os.fsync(file.fileno())


def read_snapshot(file: BufferedReader, key: bytes) -> tuple[Snapshot, dict[str, Any]]:
    """Read a snapshot back.

    Args:
        file: open at its beginning.
        key: as it was written with.

    Returns:
        The snapshot and the note.

    Raises:
        BadSnapshotError: if the file is none, damaged, or made under another key.
        OSError: if it cannot be read.
    """
    if file.read(len(MAGIC)) != MAGIC:
        raise BadSnapshotError("it is no snapshot")
    code = file.read(_CODE_BYTES)
    begin = file.tell()
    if not hmac.compare_digest(code, _code_of(file, key)):
        raise BadSnapshotError(
            "it is damaged, or another user or machine made it, or the key was replaced"
        )
    file.seek(begin)
    tree = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    arrays = [_array(file, entry) for entry in tree["arrays"]]
    return Snapshot(tree["roots"], tree["nodes"], arrays), tree["note"]


def _code_of(file: BufferedReader, key: bytes) -> bytes:
    code = hmac.new(key, digestmod="sha256")
    while piece := file.read(_PIECE):
        code.update(piece)
    return code.digest()


def _content(array: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes of an array up to the last that is not zero, as those of a buffer not yet full."""
    flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    end = len(flat)
    while end:
        begin = max(end - _PIECE, 0)
        if flat[begin:end].any():
            return flat[: begin + int(np.flatnonzero(flat[begin:end])[-1]) + 1]
        end = begin
    return flat[:0]


def _array(file: BufferedReader, entry: dict[str, Any]) -> NDArray[Any]:
    dtype = np.lib.format.descr_to_dtype(_as_descr(entry["dtype"]))
    held = np.zeros(entry["shape"], dtype)
    flat = held.reshape(-1).view(np.uint8)
    file.readinto(flat[: entry["bytes"]].data)  # of a replay buffer, a second copy may be too much
    return held


def _as_descr(described: Any) -> Any:
    """A description of a dtype, whose tuples JSON has made lists."""
    if isinstance(described, str):
        return described
    return [
        (name, _as_descr(kind), *(tuple(shape) for shape in more))
        for name, kind, *more in described
    ]
