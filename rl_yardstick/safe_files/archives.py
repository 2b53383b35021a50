"""Reads members and settings from zips of models, without importing the libraries."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

from rl_yardstick.safe_files.files import Budget, UnsafeFileError, shown

SETTINGS = "data"
_TEXTS = frozenset({SETTINGS, "_stable_baselines3_version", "system_info.txt"})
TENSORS = ".pth"  # the ending of files of tensors

# The signature of each entry in a zip's directory, and the bytes of Python's object for it.
_ENTRY, _BYTES_PER_ENTRY = b"PK\1\2", 1000
# The library stores members uncompressed. A repacked zip may deflate them; then the budget is
# charged twice the unpacked size, because Python joins the pieces.
_COPIES = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 2}


def read_members(content: bytes, budget: Budget | None = None) -> dict[str, bytes]:
    """Read the members of a zip, stored or deflated, by name, within the budget."""
    budget = budget or Budget(len(content))
    budget.charge(content.count(_ENTRY) * _BYTES_PER_ENTRY)
    members = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            if any(info.compress_type not in _COPIES for info in infos):
                raise UnsafeFileError("has a compression method that is not read here")
            budget.charge(sum(info.file_size * _COPIES[info.compress_type] for info in infos))
            for info in infos:
                with archive.open(info) as member:  # may hold more than it declares
                    members[info.filename] = member.read(info.file_size)
                if len(members[info.filename]) != info.file_size:
                    raise UnsafeFileError(f"{shown(info.filename)} is cut off")
    except UnsafeFileError:
        raise
    except Exception as error:  # damaged, encrypted, or of an unknown kind
        raise UnsafeFileError(f"is no whole zip: {error}") from error
    return members


def read_model_members(content: bytes, budget: Budget) -> dict[str, bytes]:
    """Read the members of a model's zip; refuses others than models have."""
    members = read_members(content, budget)
    for name in members:
        if name not in _TEXTS and not name.endswith(TENSORS):
            raise UnsafeFileError(f"holds {shown(name)}, which no model file has")
    if SETTINGS not in members or not any(name.endswith(TENSORS) for name in members):
        raise UnsafeFileError("lacks parts that a model has")
    return members


def first_look(content: bytes) -> dict[str, Any]:
    """Read the settings in a model's zip, without the libraries; pickled settings stay text."""
    budget = Budget(len(content))
    return parse_settings(read_model_members(content, budget), budget)


def parse_settings(members: Mapping[str, bytes], budget: Budget) -> dict[str, Any]:
    """Parse the settings of a model, which are JSON."""
    budget.charge_json(members[SETTINGS])
    try:
        data = json.loads(members[SETTINGS].decode())
    except (ValueError, RecursionError) as error:
        raise UnsafeFileError(f"has settings that are no JSON: {error}") from error
    if not isinstance(data, dict):
        raise UnsafeFileError("has settings that do not map names to values")
    return data
