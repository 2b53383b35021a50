"""Where wrappers and callbacks write: inside one folder, whatever a file of settings says.

An argument is taken for a place by its name, so that the rule holds for classes of the user's too.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path, PureWindowsPath
from typing import Any

from pipeline.errors import UserError, shown

_NAME_OF_A_PLACE = re.compile(
    r"path|folder|file|prefix|dir$|(^|_)(log|logs|dir|directory)(_|$)", re.IGNORECASE
)


def names_a_place(argument: str) -> bool:
    """Whether an argument of that name says where something is written."""
    return _NAME_OF_A_PLACE.search(argument) is not None


def confined(kwargs: Mapping[str, Any], folder: Path | None, where: str) -> dict[str, Any]:
    """The arguments, with those that name a place leading into the folder.

    Args:
        kwargs: arguments of a wrapper or callback, nested ones too.
        folder: the run's; None where there is none, for a temporary one that goes with the process.
        where: begins every error message.

    Raises:
        UserError: if one leads out of the folder.
    """
    return {
        name: _confined(name, value, folder, f"{where}: {name}") for name, value in kwargs.items()
    }


def _confined(name: str, value: Any, folder: Path | None, where: str) -> Any:
    if isinstance(value, dict):
        return {
            key: _confined(f"{name}_{key}", item, folder, f"{where}: {key}")
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return type(value)(_confined(name, item, folder, where) for item in value)
    if not (isinstance(value, str | Path) and names_a_place(name)):
        return value
    if "prefix" in name.lower():
        return _plain_prefix(str(value), where)
    return _inside(_scratch_folder() if folder is None else folder, str(value), where)


def _plain_prefix(value: str, where: str) -> str:
    if PureWindowsPath(value).name != value or value == "..":
        raise UserError(
            f"{where} begins the names of files and holds no path, unlike {shown(value)}"
        )
    return value


def _inside(folder: Path, value: str, where: str) -> str:
    # Read as on Windows, where both slashes part folders and a drive's letter leads out as well.
    pure = PureWindowsPath(value)
    leads_out = bool(pure.anchor) or ".." in pure.parts or "\0" in value
    # Where it leads by way of links.
    if leads_out or not (folder / value).resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{where} must lie inside the run folder, unlike {shown(value)}")
    return str(folder / value)


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="yardstick-", ignore_cleanup_errors=True)


def _scratch_folder() -> Path:
    return Path(_scratch().name)
