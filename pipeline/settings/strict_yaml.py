"""YAML without surprises: plain data only, no key twice, and errors that say where.

Beside `yaml.safe_load`, three things differ: a repeated key is refused instead of winning silently,
dates and other tags stay what they look like or are refused, and ``1e-4`` is a number, as YAML 1.2
has it, not a text.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, SequenceNode

from pipeline.errors import UserError
from pipeline.settings.yaml_loaders import SavedSettingsLoader, StrictLoader
from safe_files.files import UnsafeFileError, read_file

# Twenty times what the longest file of settings has, and read in well under a second.
_MAX_BYTES = 256 * 1024


def parse_yaml(content: str | bytes, where: str) -> Any:
    """Read one YAML document.

    Args:
        content: the document; bytes may be UTF-8 or UTF-16.
        where: the file it comes from, for error messages.

    Returns:
        Nested lists, dictionaries, texts, numbers, booleans and None.

    Raises:
        UserError: if it is not YAML, holds anything but plain data, or a key twice.
    """
    return _parse(content, where, StrictLoader)


def _parse(content: str | bytes, where: str, loader: type[StrictLoader]) -> Any:
    if len(content) > _MAX_BYTES:
        raise UserError(f"{where}: is larger than {_MAX_BYTES:,} bytes")
    try:
        loader_class: Any = loader  # mypy takes no class for hashable
        return deepcopy(_load(content, loader_class))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        raise UserError(f"{where}{place}: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise UserError(f"{where}: is not a text file, or holds control characters") from error
    except (RecursionError, ValueError) as error:
        raise UserError(f"{where}: is nested too deeply, or too large") from error


def read_yaml(path: Path) -> Any:
    """Read the one YAML document in a file; see `parse_yaml`.

    Raises:
        UserError: if the file cannot be read, or is not such a document.
    """
    return _parse(_content(path), str(path), StrictLoader)


def read_saved_settings(path: Path) -> dict[str, Any]:
    """Read the settings that a run folder keeps, ours or rl_zoo3's; see `parse_yaml`.

    rl_zoo3 writes them as an OrderedDict with the name of its class, the one tag that is admitted.

    Raises:
        UserError: if the file cannot be read, or does not map names to plain data.
    """
    value = _parse(_content(path), str(path), SavedSettingsLoader)
    if not (isinstance(value, dict) and all(isinstance(key, str) for key in value)):
        raise UserError(f"{path}: must map names to values")
    return value


def _content(path: Path) -> bytes:
    try:
        return read_file(path, _MAX_BYTES)
    except UnsafeFileError as error:
        raise UserError(str(error)) from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{path}: cannot be read: {reason}") from error


def read_settings_text(path: Path) -> str:
    """The text of a file of settings, for what needs no more than a look at it.

    Raises:
        UserError: if the file cannot be read, or is no text in UTF-8.
    """
    try:
        return _content(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not a text file, or holds control characters") from error


def key_lines(path: Path) -> dict[tuple[str | int, ...], int]:
    """The line on which each value of a file stands, for messages about what it means.

    Args:
        path: a file that `read_yaml` has read.

    Returns:
        Line numbers, counted from 1, by the keys and indexes that lead to the value.
    """
    loader = StrictLoader(_content(path))
    try:
        node = loader.get_single_node()
        return {} if node is None else dict(_node_lines(node, ()))
    finally:
        loader.dispose()


def _node_lines(
    node: Node, keys: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], int]]:
    yield keys, node.start_mark.line + 1
    if isinstance(node, MappingNode):
        for key, value in node.value:
            inner = (*keys, str(key.value))
            yield from _node_lines(value, inner)
            # Where the key stands, and not where its value begins.
            yield inner, key.start_mark.line + 1
    elif isinstance(node, SequenceNode):
        for index, value in enumerate(node.value):
            yield from _node_lines(value, (*keys, index))


@lru_cache(maxsize=32)  # a study asks for the same entries again and again
def _load(content: str | bytes, loader_class: Any) -> Any:
    loader = loader_class(content)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()
