"""Reads members and settings from zips of models, without importing the libraries.

It unpacks no more bytes than the budget of the file allows.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rl_yardstick.safe_files.files import Budget, UnsafeFileError, shown

SETTINGS = "data"
_NETWORKS = "policy policy.optimizer actor.optimizer critic.optimizer ent_coef_optimizer"
TENSORS = frozenset(f"{name}.pth" for name in f"{_NETWORKS} pytorch_variables tensors".split())
MEMBERS = TENSORS | {SETTINGS, "_stable_baselines3_version", "system_info.txt"}
# The user's algorithms may add further files of tensors.
_TENSORS = re.compile(r"\w[\w.]*\.pth", re.ASCII)

MAX_MEMBERS = 64
# Far more digits than a step counter needs.
MAX_INTEGER_BITS = 128
# The signature of each entry in a zip's directory, and the bytes of Python's object for it.
_ENTRY, _BYTES_PER_ENTRY = b"PK\1\2", 1000
# The library stores members uncompressed. A repacked zip may deflate them; then the budget is
# charged twice the unpacked size, because Python joins the pieces.
_COPIES = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 2}

# Python's exceptions for zips that are damaged, encrypted, or of an unknown kind.
_ODD = (OverflowError, RuntimeError, ValueError)
_DAMAGE = (zipfile.BadZipFile, zlib.error, OSError, EOFError, *_ODD)


def read_members(
    content: bytes,
    expected: frozenset[str] | None = None,
    budget: Budget | None = None,
    most: int = MAX_MEMBERS,
) -> dict[str, bytes]:
    """Read at most ``most`` members of a zip, by name; refuses names outside ``expected``."""
    budget = budget or Budget(len(content))
    with opened_zip(content, budget) as archive:
        infos = archive.infolist()
        strange = sorted({info.filename for info in infos} - expected) if expected else []
        if strange:
            raise UnsafeFileError(f"holds {shown(strange[0])}, which no model file has")
        if len(infos) > most:
            raise UnsafeFileError(f"holds more than {most} members")
        budget.charge(sum(info.file_size * _COPIES[info.compress_type] for info in infos))
        return {info.filename: read_member(archive, info) for info in infos}


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Read a member of a zip; unpacks no more than the member's declared size."""
    with archive.open(info) as member:
        content = member.read(info.file_size)
    if len(content) != info.file_size:
        raise UnsafeFileError(f"{shown(info.filename)} is cut off")
    return content


@contextmanager
def opened_zip(content: bytes, budget: Budget) -> Iterator[zipfile.ZipFile]:
    """Open a zip that contains no member twice."""
    budget.charge(content.count(_ENTRY) * _BYTES_PER_ENTRY)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            if len({info.filename for info in infos}) != len(infos):
                raise UnsafeFileError("holds a member twice")
            if any(info.compress_type not in _COPIES for info in infos):
                raise UnsafeFileError("has a compression method that is not read here")
            yield archive
    except UnsafeFileError:
        raise
    except _DAMAGE as error:
        raise UnsafeFileError(f"is no whole zip: {error}") from error


def first_look(content: bytes) -> dict[str, Any]:
    """Read the settings in a model's zip, checked as far as possible without the libraries.

    Pickled settings stay text.
    """
    budget = Budget(len(content))
    members = read_members(content, budget=budget)
    strange = sorted(
        name for name in members if name not in MEMBERS and not _TENSORS.fullmatch(name)
    )
    if strange:
        raise UnsafeFileError(f"holds {shown(strange[0])}, which no model file has")
    tensors = [name for name in members if name.endswith(".pth")]
    if SETTINGS not in members or not tensors:
        raise UnsafeFileError("lacks parts that a model has")
    for name in tensors:
        with opened_zip(members[name], budget):
            pass
    return parse_settings(members, budget)


def parse_settings(members: Mapping[str, bytes], budget: Budget) -> dict[str, Any]:
    """Parse the settings of a model, which are JSON."""
    if SETTINGS not in members:
        raise UnsafeFileError("is no whole zip of a model: it lacks its settings")
    budget.charge_json(members[SETTINGS])
    try:
        data = json.loads(members[SETTINGS].decode(), parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise UnsafeFileError(f"has settings that are no JSON: {error}") from error
    if not isinstance(data, dict):
        raise UnsafeFileError("has settings that do not map names to values")
    return data


def _integer(digits: str) -> int:
    if len(digits) > MAX_INTEGER_BITS:
        raise UnsafeFileError("holds an absurdly large number")
    return int(digits)
