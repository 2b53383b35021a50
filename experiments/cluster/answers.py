"""What comes back of a run: how it ended, and where folders are not shared, the files it left.

An answer is bytes: the length of a head, the head as JSON, and the files one after the other. There
is no place in it for links, modes or code. Whoever reads one trusts nothing in it: names, sizes and
digests are checked before anything is written, and what the run was asked for after.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.files import portable_name

# The last is for a worker that can do no run at all.
DONE, FAILED, STOPPED, UNFIT = "done", "failed", "stopped", "unfit"
KINDS = (DONE, FAILED, STOPPED, UNFIT)
LARGEST = 256 << 20  # bytes, of all files of a run
MOST_FILES = 10_000
LONGEST_TEXT = 200_000  # characters
_LARGEST_HEAD = 8 << 20  # bytes
_LONGEST_PATH = 1000
_DEEPEST = 8  # folders
_LENGTH = struct.Struct(">Q")


class RefusedAnswerError(ValueError):
    """An answer is none, or holds what it may not."""


@dataclass(frozen=True)
class Answer:
    """What a worker says of a run.

    Attributes:
        kind: one of `KINDS`.
        reason: why it failed.
        details: the same at length.
        files: what it left, by relative name; None where it says that it lies in its place already.
    """

    kind: str
    reason: str = ""
    details: str = ""
    files: dict[str, bytes] | None = field(default=None, repr=False)


def packed(answer: Answer) -> bytes:
    """The answer as bytes."""
    files = answer.files
    head = {
        "kind": answer.kind,
        "reason": answer.reason[:LONGEST_TEXT],
        "details": answer.details[-LONGEST_TEXT:],
        "files": None
        if files is None
        else [[name, len(data), _digest(data)] for name, data in sorted(files.items())],
    }
    text = json.dumps(head).encode()
    contents = [files[name] for name in sorted(files)] if files else []
    return b"".join([_LENGTH.pack(len(text)), text, *contents])


def unpacked(content: object) -> Answer:
    """The answer that bytes hold.

    Raises:
        RefusedAnswerError: if they hold none, or one with files that may not be written.
    """
    if not isinstance(content, bytes):
        raise RefusedAnswerError(f"it is a {type(content).__name__}, and not bytes")
    head, rest = _head(content)
    texts = [head.get(name) for name in ("kind", "reason", "details")]
    if not all(isinstance(text, str) and len(text) <= LONGEST_TEXT for text in texts):
        raise RefusedAnswerError("its head lacks a text, or one is too long")
    kind, reason, details = map(str, texts)
    if kind not in KINDS:
        raise RefusedAnswerError(f"{kind[:20]!a} is no way to end")
    listed = head.get("files")
    if listed is None:
        return Answer(kind, reason, details)
    return Answer(kind, reason, details, dict(_files(listed, rest)))


def files_in(folder: Path, prefix: str) -> dict[str, bytes]:
    """All files in a folder, by relative name after a prefix.

    Raises:
        ValueError: if they are more, or larger, than an answer takes.
    """
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    size = sum(path.stat().st_size for path in paths)
    if size > LARGEST or len(paths) > MOST_FILES:
        raise ValueError(
            f"left {len(paths):,} files of {size:,} bytes, and a worker that shares no folder can "
            f"send {MOST_FILES:,} of {LARGEST:,}: let it share the study's folder"
        )
    return {prefix + path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _digest(content: bytes | memoryview) -> str:
    return hashlib.sha256(content).hexdigest()


def _head(content: bytes) -> tuple[dict[str, Any], memoryview]:
    if len(content) < _LENGTH.size:
        raise RefusedAnswerError("it is cut off")
    (length,) = _LENGTH.unpack_from(content)
    end = _LENGTH.size + length
    if length > _LARGEST_HEAD or end > len(content):
        raise RefusedAnswerError("its head is cut off, or too long")
    try:
        head = json.loads(content[_LENGTH.size : end])
    except (ValueError, RecursionError) as error:
        raise RefusedAnswerError("its head is no JSON") from error
    if not isinstance(head, dict):
        raise RefusedAnswerError("its head maps no names to values")
    return head, memoryview(content)[end:]


def _files(listed: Any, rest: memoryview) -> Iterator[tuple[str, bytes]]:
    if not isinstance(listed, list) or len(listed) > MOST_FILES or len(rest) > LARGEST:
        raise RefusedAnswerError("it lists no files, too many, or they are too large")
    start, names = 0, set()
    for entry in listed:
        match entry:
            case [str(name), int(size), str(digest)] if not isinstance(size, bool) and size >= 0:
                pass
            case _:
                raise RefusedAnswerError("it lists something else than files")
        _check_name(name)
        # Some file systems do not tell upper from lower case.
        if name.casefold() in names:
            raise RefusedAnswerError(f"it lists {name!a} twice")
        names.add(name.casefold())
        piece = rest[start : start + size]
        if len(piece) != size or _digest(piece) != digest:
            raise RefusedAnswerError(f"{name!a} is not what its digest says")
        start += size
        yield name, bytes(piece)
    if start != len(rest):
        raise RefusedAnswerError("something follows its files")
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    if not folders.isdisjoint(names):
        raise RefusedAnswerError("a file in it is a folder too")


def _check_name(name: str) -> None:
    """Refuse names that lead elsewhere, or that some system would not take as they are."""
    parts = name.split("/")
    if len(name) > _LONGEST_PATH or not 2 <= len(parts) <= _DEEPEST:
        raise RefusedAnswerError(f"{name[:80]!a} is no name of a file that a run leaves")
    for part in parts:
        if part in ("", ".", "..") or portable_name(part, 255) != part:
            raise RefusedAnswerError(f"{name!a} would lie elsewhere")
