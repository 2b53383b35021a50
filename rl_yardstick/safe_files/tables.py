"""Reads files with tables as data: arrays, dictionaries and lists of numbers, of unknown origin.

Known are NumPy's files, pickles of protocols 0 to 5, JSON, CSV, and tensors of PyTorch, which are
read without it. A pickle may hold arrays, dictionaries of any kind whose keys are numbers, texts
and tuples of them, and objects of any class, as dictionaries of those attributes that can be read:
no class of the file is looked up, and nothing in it is called.
"""

from __future__ import annotations

import csv
import io
import json
import math
import pickle
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.safe_files.arrays import ARRAYS
from rl_yardstick.safe_files.files import (
    MAX_ARCHIVE_BYTES,
    Budget,
    Source,
    UnsafeFileError,
    content_of,
    read_members,
    shown,
)
from rl_yardstick.safe_files.pickles import (
    DICTIONARY,
    INSTRUCTIONS,
    PERSISTENT_ID,
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
_STATES = {"", "s", "state", "states", "obs", "observation", "index"}
_ACTIONS = {"a", "action", "actions"}


def read_table_file(source: Source) -> Any:
    """Read a file that holds a table, by its content; the suffix decides between texts alone.

    Returns:
        arrays, and dictionaries, lists and tuples of arrays, numbers and texts. An archive of
        arrays becomes a dictionary. A row of a CSV file with a heading becomes a dictionary by
        heading, and rows that begin with a state one by state.

    Raises:
        UnsafeFileError: if the file is empty, damaged, too large or of another kind, or holds
            anything that is no data.
    """
    content = content_of(source, MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    suffix = Path(source).suffix.lower() if isinstance(source, str | Path) else ""
    if not content.strip():
        raise UnsafeFileError("is empty")
    try:
        if content.startswith(b"\x93NUMPY"):
            return _array_file(content, budget)
        if content.startswith(b"PK\3\4"):
            return _archive(content, budget)
        if content.startswith(b"\x1f\x8b"):
            raise UnsafeFileError("is compressed: unpack it first")
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
    """Records pickles of all protocols, also those of Python 2."""

    instructions: ClassVar[frozenset[str]] = INSTRUCTIONS | frozenset(
        ["INT", "LONG", "FLOAT", "UNICODE", "STRING", "BINSTRING", "SHORT_BINSTRING", "LIST", "DICT", "PUT", "GET"]
    )
    dispatch: ClassVar[dict[int, Any]] = dict(Reader.dispatch)

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file, budget)
        self.encoding = "latin1"  # of Python 2's texts, which hold the bytes of arrays as well

    def load_filled_dictionary(self) -> None:
        items = self.pop_mark()  # type: ignore[attr-defined]
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
        for key, value in () if state is None else zip(state.items[::2], state.items[1::2]):
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
    if not (plain is None or isinstance(plain, str | int | float)):
        raise UnsafeFileError(f"uses a {type(plain).__name__} as a key")
    if isinstance(plain, int) and abs(plain) >= _END_OF_KEYS:
        raise UnsafeFileError("uses a large number as a key")
    return plain


def _as_dictionary(made: Made, build: Build) -> Any:
    """A defaultdict, whose maker of missing values is not built, an OrderedDict or a Counter."""
    assert isinstance(build, TableBuild)
    given = made.args[0] if made.args else None
    found: dict[Any, Any] = {}
    if isinstance(given, Made) and given.name == DICTIONARY:
        found = build.dictionary(given.items)
    elif isinstance(given, list):  # of pairs, as of an OrderedDict in Python 2
        found = build.dictionary([part for pair in given for part in pair])
    return {**found, **build.dictionary(made.items)}


def _encoded(made: Made, build: Build) -> bytes:
    text, encoding = build(made.args)
    if encoding != "latin1":
        raise wrong(made)
    return bytes(text, encoding)


def _of_latin(made: Made, build: Build) -> Any:
    """As in `ARRAYS`, of which Python 2 holds the bytes as a text."""
    parts = made.state if made.name.endswith("_reconstruct") else made.args
    if isinstance(parts, tuple) and parts and isinstance(parts[-1], str):
        parts = (*parts[:-1], parts[-1].encode("latin1"))
        made = Made(made.name, parts, parts)
    return ARRAYS[made.name](made, build)


_MAKERS: Mapping[str, Maker] = {
    **ARRAYS,
    **{f"numpy._core.multiarray.{name}": _of_latin for name in ("_reconstruct", "scalar")},
    **{f"collections.{name}": _as_dictionary for name in ("defaultdict", "OrderedDict", "Counter")},
    "_codecs.encode": _encoded,
    **dict.fromkeys(("builtins.bytes", "__builtin__.bytes"), lambda made, build: b""),
}


def read_pickled_table(
    content: bytes, budget: Budget | None = None, makers: Mapping[str, Maker] | None = None
) -> Any:
    """Build the value of a pickle as data; ``makers`` allow further objects."""
    budget = budget or Budget(len(content))
    budget.left += min(_TIMES_DENSE * len(content), _MOST_DENSE)
    tree = TableReader(io.BytesIO(content), budget).load()
    return TableBuild({**_MAKERS, **(makers or {})}, {}, budget)(tree)


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
    if dtype.kind not in "biuf":
        raise UnsafeFileError("holds an array of a type other than numbers")
    count = math.prod(shape)
    if count * dtype.itemsize > len(rest):
        raise UnsafeFileError(f"is cut off: an array of shape {shape} is larger than the file")
    flat: NDArray[Any] = np.frombuffer(rest, dtype, count)
    return flat.reshape(shape, order="F" if is_fortran else "C")


def _archive(content: bytes, budget: Budget) -> Any:
    """The arrays of an .npz file by name, or the value of a .pt or .pth file."""
    members = read_members(content, budget)
    pickled = [name for name in members if name.rpartition("/")[2] == "data.pkl"]
    if pickled:
        folder = pickled[0].removesuffix("data.pkl")
        tensors: Any = {PERSISTENT_ID: partial(_storage, members, folder)}
        tensors |= {f"torch._utils.{name}": maker for name, maker in _OF_TENSORS.items()}
        return read_pickled_table(members[pickled[0]], budget, tensors)
    if not all(name.endswith(".npy") for name in members):
        raise UnsafeFileError("is a zip that holds no arrays")
    arrays = {name.removesuffix(".npy"): held for name, held in members.items()}
    return {name: _array_file(held, budget) for name, held in arrays.items()}


_STORAGES = {"Bool": "?", "Byte": "u1", "Char": "i1", "Short": "i2", "Int": "i4", "Long": "i8"}
_STORAGES |= {"Half": "f2", "Float": "f4", "Double": "f8"}


def _storage(members: Mapping[str, bytes], folder: str, made: Made, _: Build) -> NDArray[Any]:
    """The numbers of a tensor's storage."""
    _, kind, key, *_ = made.args[0]
    name = kind.name.removeprefix("torch.").removesuffix("Storage")
    return np.frombuffer(members[f"{folder}data/{key}"], np.dtype(_STORAGES[name]))


def _tensor(made: Made, build: Build) -> NDArray[Any]:
    """The array of a tensor; no element lies outside of its storage."""
    storage, first, shape, strides = build(made.args[:4])
    last = first + sum(step * (n - 1) for n, step in zip(shape, strides, strict=True))
    if min(first, *shape, *strides) < 0 or (math.prod(shape) and last >= len(storage)):
        raise UnsafeFileError("a tensor that is larger than its storage")
    build.budget.charge(math.prod(shape) * storage.itemsize)
    steps = [step * storage.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(storage[first:], shape, steps).copy()


_OF_TENSORS: Mapping[str, Maker] = {
    "_rebuild_tensor_v2": _tensor,
    "_rebuild_parameter": lambda made, build: build(made.args[0]),
}


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
    if begins and begins[0] in _STATES:
        return {row[0]: _by_heading(heading[1:], row[1:]) for row in rows}
    if heading:
        return [_by_heading(heading, row) for row in rows]
    try:
        return np.array([[float(cell) for cell in row] for row in rows])
    except ValueError:
        if all(map(_is_number, (cell for row in rows for cell in row[1:]))):
            return {row[0]: np.array([float(cell) for cell in row[1:]]) for row in rows}
        found = next(cell for row in rows for cell in row if not _is_number(cell))
        raise UnsafeFileError(f"holds {shown(found)}, which is no number") from None


def _by_heading(heading: list[str], row: list[str]) -> dict[str, float]:
    return {name: float(cell) for name, cell in zip(heading, row, strict=True)}


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
