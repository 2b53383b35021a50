"""Reads files with tables as data: arrays, dictionaries and lists of numbers, of unknown origin.

A pickle, of protocols 0 to 5, may hold arrays, and dictionaries of any kind whose keys are numbers,
texts and tuples of them: no class of the file is looked up, and nothing in it is called.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.safe_files import files
from rl_yardstick.safe_files.arrays import ARRAYS
from rl_yardstick.safe_files.files import Budget, Source, UnsafeFileError, refused_as
from rl_yardstick.safe_files.pickles import DICTIONARY, END_OF_KEYS, Build, Made, Reader

# A dictionary of small keys takes many times its pickle: more than a model may, up to a limit.
_TIMES_DENSE, _MOST_DENSE = 300, 1 << 30
_BYTES_PER_CELL = 200  # of a CSV file
_NUMBER = re.compile(r"\d|nan|inf", re.IGNORECASE)
_STATES = ("", "s", "state", "states", "obs", "observation", "unnamed: 0")  # headings


def read_table_file(source: Source) -> Any:
    """Read a file that holds a table, by its content; the suffix tells JSON and CSV apart.

    Returns:
        arrays, and dictionaries, lists and tuples of arrays, numbers and texts. An archive of
        arrays becomes a dictionary by name, and a CSV file whose rows begin with a state one by
        state.

    Raises:
        UnsafeFileError: if the file is empty, damaged, too large or of another kind, or holds
            anything that is no data.
    """
    content = files.content_of(source, files.MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    suffix = Path(source).suffix.lower() if isinstance(source, str | Path) else ""
    if not content.strip():
        raise UnsafeFileError("is empty")
    with refused_as("cannot be read"):
        if content.startswith(b"\x93NUMPY"):
            return _array_file(content, budget)
        if content.startswith(b"PK\3\4"):
            return _archive(content, budget)
        if suffix == ".json":
            budget.charge_json(content)
            return json.loads(content.decode("utf-8-sig"))
        if suffix in (".csv", ".tsv", ".txt"):
            return table_of_text(content.decode("utf-8-sig"), budget)
        if not content.rstrip().endswith(b"."):
            raise UnsafeFileError("is cut off, or no .npy, .npz, .json, .csv, pickle or newer .pt")
        return read_pickled_table(content, budget)


# Of any module, since nothing is called; a defaultdict's maker of missing values is not built.
_KINDS = (DICTIONARY, "defaultdict", "OrderedDict", "Counter")


class TableBuild(Build):
    """Builds tables from records, by keys that are numbers, texts and tuples of them."""

    def _make(self, tree: Any) -> Any:
        if not (isinstance(tree, Made) and tree.name.rpartition(".")[2] in _KINDS):
            return super()._make(tree)
        given = tree.args[0] if tree.args else None
        first = given.items if isinstance(given, Made) and given.name == DICTIONARY else []
        items = [*first, *tree.items]
        pairs = zip(items[::2], items[1::2], strict=True)
        return {_checked_key(self(key)): self(value) for key, value in pairs}


def _checked_key(key: Any) -> Any:
    """The key, with Python's numbers in place of NumPy's; its hash takes no longer than it."""
    if isinstance(key, tuple):
        return tuple(map(_checked_key, key))
    plain = key.item() if isinstance(key, np.generic) else key
    is_large = isinstance(plain, int) and abs(plain) >= END_OF_KEYS
    if is_large or not isinstance(plain, str | int | float | None):
        raise UnsafeFileError(f"uses a {'large' if is_large else ''} {type(plain).__name__} as key")
    return plain


def read_pickled_table(content: bytes, budget: Budget) -> Any:
    """Build the value of a pickle as data."""
    budget.left += min(_TIMES_DENSE * len(content), _MOST_DENSE)
    tree = Reader(io.BytesIO(content), budget).load()
    return TableBuild(ARRAYS, {}, budget)(tree)


def _array_file(content: bytes, budget: Budget) -> Any:
    """The array of an .npy file; one of objects holds a pickle."""
    file = io.BytesIO(content)
    np.lib.format.read_magic(file)
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    rest = content[file.tell() :]
    if dtype == np.dtype(object):
        return read_pickled_table(rest, budget)
    if dtype.kind not in "biuf" or math.prod(shape) * dtype.itemsize > len(rest):
        raise UnsafeFileError(f"is cut off, or holds no numbers: an array {shape} of {dtype}")
    flat: NDArray[Any] = np.frombuffer(rest, dtype, math.prod(shape))
    return flat.reshape(shape, order="F" if is_fortran else "C")


def _archive(content: bytes, budget: Budget) -> Any:
    """The arrays of an .npz file by name, or the value of a .pt or .pth file."""
    members = files.read_members(content, budget)
    if any(name.endswith("data.pkl") for name in members):
        from rl_yardstick.safe_files.known_objects import load_tensors, tensors_in

        found = tensors_in(load_tensors(content, budget))
        return {name: tensor.detach().numpy() for name, tensor in found}
    return {name.removesuffix(".npy"): _array_file(members[name], budget) for name in members}


def table_of_text(text: str, budget: Budget) -> Any:
    """A text with separators: an array, or a dictionary if rows begin with a state (and action)."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((sign for sign in "\t;," if sign in lines[0]), " ")
    budget.charge(_BYTES_PER_CELL * (text.count(separator) + len(lines)))
    rows = list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
    heading = [] if all(map(_NUMBER.search, rows[0])) else [one.lower() for one in rows.pop(0)]
    if not heading or heading[0] not in _STATES:
        with suppress(ValueError):
            return np.array(rows, dtype=np.float64)
    at = int(len(heading) > 1 and heading[1] in _STATES)  # behind the numbers of rows
    end = at + 1 + (heading[at + 1 : -1] == ["action"])
    found = {", ".join(row[at:end]): np.array(row[end:], np.float64).squeeze() for row in rows}
    if len(found) < len(rows):
        raise UnsafeFileError("has several rows of one state, not named state, action, value")
    return found
