"""Reads files with tables as data: arrays, dictionaries and lists of numbers, of unknown origin.

A pickle, of protocols 0 to 5, may hold arrays, dictionaries of any kind whose keys are numbers,
texts and tuples of them, and objects of any class, as dictionaries of those attributes that can be
read: no class of the file is looked up, and nothing in it is called.
"""

from __future__ import annotations

import csv
import io
import json
import math
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.safe_files import files
from rl_yardstick.safe_files.arrays import ARRAYS
from rl_yardstick.safe_files.files import Budget, Source, UnsafeFileError
from rl_yardstick.safe_files.pickles import (
    DICTIONARY,
    INSTRUCTIONS,
    Build,
    Made,
    Maker,
    Reader,
    wrong,
)

# A dictionary of small keys takes many times its pickle: more than a model may, up to a limit.
_TIMES_DENSE, _MOST_DENSE = 300, 1 << 30
_BYTES_PER_CELL = 200  # of a CSV file
_END_OF_KEYS = (1 << 61) - 1  # larger integers are not their own hash
_NUMBER = re.compile(r"\d|nan|inf", re.IGNORECASE)
_OLD = frozenset(["INT", "LONG", "FLOAT", "UNICODE", "LIST", "DICT", "PUT", "GET"])
_STATES, _ACTIONS = ("", "s", "state", "states", "obs", "observation"), ("a", "action", "actions")


def read_table_file(source: Source) -> Any:
    """Read a file that holds a table, by its content; the suffix tells JSON and CSV apart.

    Returns:
        arrays, and dictionaries, lists and tuples of arrays, numbers and texts. An archive of
        arrays becomes a dictionary. A row of a CSV file with a heading becomes a dictionary by
        heading, and rows that begin with a state one by state.

    Raises:
        UnsafeFileError: if the file is empty, damaged, too large or of another kind, or holds
            anything that is no data.
    """
    content = files.content_of(source, files.MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    suffix = Path(source).suffix.lower() if isinstance(source, str | Path) else ""
    if not content.strip():
        raise UnsafeFileError("is empty")
    try:
        if content.startswith(b"\x93NUMPY"):
            return _array_file(content, budget)
        if content.startswith(b"PK\3\4"):
            return _archive(content, budget)
        if suffix == ".json":
            budget.charge_json(content)
            return json.loads(content.decode("utf-8-sig"))
        if suffix in (".csv", ".tsv", ".txt"):
            return _rows(content.decode("utf-8-sig"), budget)
        return read_pickled_table(content, budget)
    except UnsafeFileError:
        raise
    except Exception as error:  # a damaged file can fail anywhere
        raise UnsafeFileError(f"cannot be read: {str(error) or type(error).__name__}") from error


# --- pickles --------------------------------------------------------------------------------------


class TableReader(Reader):
    """Records pickles of all protocols."""

    instructions: ClassVar[frozenset[str]] = INSTRUCTIONS | _OLD
    dispatch: ClassVar[dict[int, Any]] = dict(Reader.dispatch)

    def load_filled_dictionary(self) -> None:
        items = self.pop_mark()
        self.append(Made(DICTIONARY, (), items=items))

    dispatch[pickle.DICT[0]] = load_filled_dictionary


class TableBuild(Build):
    """Builds tables from records."""

    def _make(self, tree: Any) -> Any:
        if isinstance(tree, Made) and tree.name == DICTIONARY:
            return self.dictionary(tree.items)
        is_object = isinstance(tree, Made) and tree.name not in self.makers and tree.args == ()
        if is_object and (tree.items or tree.state is not None):
            return self.attributes(tree)
        return super()._make(tree)

    def dictionary(self, items: list[Any]) -> dict[Any, Any]:
        """The keys, which are numbers, texts and tuples of them, with their values."""
        pairs = zip(items[::2], items[1::2], strict=True)
        return {_checked_key(self(key)): self(value) for key, value in pairs}

    def attributes(self, made: Made) -> dict[Any, Any]:
        """The attributes of an object that can be read, and the items of a kind of dictionary."""
        state = made.state[0] if isinstance(made.state, tuple) and made.state else made.state
        if not (state is None or (isinstance(state, Made) and state.name == DICTIONARY)):
            raise wrong(made)
        found, depth = self.dictionary(made.items), self.depth
        items = [] if state is None else state.items
        for key, value in zip(items[::2], items[1::2], strict=True):
            try:
                found[_checked_key(self(key))] = self(value)
            except UnsafeFileError:
                if self.budget.left < 0:
                    raise
                self.depth = depth
        return found


def _checked_key(key: Any) -> Any:
    """The key, with Python's numbers in place of NumPy's; its hash takes no longer than it."""
    if isinstance(key, tuple):
        return tuple(map(_checked_key, key))
    plain = key.item() if isinstance(key, np.generic) else key
    is_large = isinstance(plain, int) and abs(plain) >= _END_OF_KEYS
    if is_large or not (plain is None or isinstance(plain, str | int | float)):
        raise UnsafeFileError(f"uses a {'large' if is_large else ''} {type(plain).__name__} as key")
    return plain


def _as_dictionary(made: Made, build: Build) -> Any:
    """A defaultdict, whose maker of missing values is not built, an OrderedDict or a Counter."""
    assert isinstance(build, TableBuild)
    given = made.args[0] if made.args else None
    is_given = isinstance(given, Made) and given.name == DICTIONARY
    return {**(build(given) if is_given else {}), **build.dictionary(made.items)}


_MAKERS: Mapping[str, Maker] = {
    **ARRAYS,
    **{f"collections.{name}": _as_dictionary for name in ("defaultdict", "OrderedDict", "Counter")},
    # How protocols 0 to 2 hold bytes.
    "_codecs.encode": lambda made, build: build(made.args)[0].encode("latin1"),
    **dict.fromkeys(("builtins.bytes", "__builtin__.bytes"), lambda made, build: b""),
}


def read_pickled_table(content: bytes, budget: Budget) -> Any:
    """Build the value of a pickle as data."""
    budget.left += min(_TIMES_DENSE * len(content), _MOST_DENSE)
    tree = TableReader(io.BytesIO(content), budget).load()
    return TableBuild(_MAKERS, {}, budget)(tree)


# --- NumPy's files, and tensors -------------------------------------------------------------------


def _array_file(content: bytes, budget: Budget) -> Any:
    """The array of an .npy file; one of objects holds a pickle."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = "read_array_header_1_0" if version == (1, 0) else "read_array_header_2_0"
    shape, is_fortran, dtype = getattr(np.lib.format, read)(file)
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
    if not all(name.endswith(".npy") for name in members):
        raise UnsafeFileError("is a zip that holds no arrays")
    arrays = {name.removesuffix(".npy"): held for name, held in members.items()}
    return {name: _array_file(held, budget) for name, held in arrays.items()}


# --- CSV ------------------------------------------------------------------------------------------


def _rows(text: str, budget: Budget) -> Any:
    """The rows of a text with separators: an array, rows by state, or values by heading."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((sign for sign in "\t;," if sign in lines[0]), " ")
    budget.charge(_BYTES_PER_CELL * (text.count(separator) + len(lines)))
    rows = [
        [cell.strip() for cell in row]
        for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)
    ]
    heading = [] if all(map(_NUMBER.search, rows[0])) else rows.pop(0)
    begins = [name.lower().removeprefix("unnamed: 0") for name in heading[:2]]
    if len(heading) == 3 and begins[0] in _STATES and begins[1] in _ACTIONS:
        return {(state, action): float(value) for state, action, value in rows}
    if heading:
        named = [dict(zip(heading, row, strict=True)) for row in rows]
        if begins[0] not in _STATES:
            return named
        return {row.pop(heading[0]): row for row in named}
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError:
        return {row[0]: np.array(row[1:], dtype=np.float64) for row in rows}
