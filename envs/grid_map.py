"""Maps of grid worlds: reading, checking, and how far each cell is from the goal."""

from __future__ import annotations

import os
from array import array
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Bools
from safe_files.files import UnsafeFileError, read_file

START = "S"
GOAL = "G"
# 4096 x 4096 cells: a Q-table of four actions then fills half a gigabyte.
MAX_STATES = 2**24
# A letter and maybe a line break for each cell.
MAX_MAP_BYTES = 3 * MAX_STATES
UNREACHED = -1

Description = Sequence[str] | str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class GridMap:
    """A rectangular map of letters; row 0 is at the top, cells are numbered row by row.

    Attributes:
        rows: the map as text.
        codes: the letters' ASCII codes, one per cell.
        start: the cell of the only ``S``.
        distances: moves from each cell to the nearest goal, -1 where there is no way; int32 of
            shape (cells,).
    """

    rows: tuple[str, ...]
    codes: bytes
    start: int
    distances: NDArray[np.int32]

    @classmethod
    def read(cls, desc: Description, known: Collection[str], passable: Collection[str]) -> GridMap:
        """Read and check a map.

        Args:
            desc: the rows; or the path to a text file that holds them; or that text itself,
                which has at least one line break.
            known: the letters that may occur.
            passable: those of them that the way to the goal may lead over, ``S`` among them.

        Raises:
            ValueError: if the file cannot be read, rows differ in length, a letter is unknown,
                there is not exactly one start or no goal, or no way between them. Where there
                is a place to name, the message names row and column, counted from one.
        """
        rows, source = _read_rows(desc)
        _check_shape(rows, source)
        _check_letters(rows, source, known)
        codes = "".join(rows).encode("ascii")
        n_columns = len(rows[0])
        start = _only_start(codes, n_columns, source)
        goals = [cell for cell, code in enumerate(codes) if code == ord(GOAL)]
        if not goals:
            raise ValueError(f"{source} has no goal: mark it with the letter {GOAL}")
        free = np.isin(np.frombuffer(codes, np.uint8), [ord(letter) for letter in passable])
        distances = distances_to(goals, free.reshape(len(rows), n_columns)).ravel()
        if distances[start] == UNREACHED:
            raise ValueError(
                f"{source}: the goal at {_place(goals[0], n_columns)} cannot be reached from the "
                f"start at {_place(start, n_columns)}"
            )
        return cls(rows, codes, start, distances)

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def n_columns(self) -> int:
        """Number of columns."""
        return len(self.rows[0])

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return len(self.codes)


def distances_to(targets: Iterable[int], free: Bools) -> NDArray[np.int32]:
    """Moves from each cell to the nearest target over free cells, by breadth-first search.

    Args:
        targets: cells to reach, numbered row by row; they need not be free.
        free: where the way may lead, bool of shape (rows, columns).

    Returns:
        int32 of the same shape, -1 where no way leads to a target.
    """
    n_rows, n_columns = free.shape
    # A border all around saves the search from asking whether it left the map. Plain Python on
    # bytes takes a third of a second for a million cells, without a library to import.
    width = n_columns + 2
    unvisited = bytearray(np.pad(free, 1).tobytes())
    distances = array("i", [UNREACHED]) * len(unvisited)
    frontier = [(cell // n_columns + 1) * width + cell % n_columns + 1 for cell in targets]
    n_moves = 0
    while frontier:
        reached = []
        for cell in frontier:
            unvisited[cell] = False
            distances[cell] = n_moves
        for cell in frontier:
            for beside in (cell - width, cell + width, cell - 1, cell + 1):
                if unvisited[beside]:
                    unvisited[beside] = False
                    reached.append(beside)
        frontier = reached
        n_moves += 1
    padded = np.frombuffer(distances, np.int32).reshape(n_rows + 2, width)
    return padded[1:-1, 1:-1].copy()


def read_rows(desc: Description) -> tuple[str, ...]:
    """The rows of a map, not checked yet; see `GridMap.read`.

    Raises:
        ValueError: if there is no such file, or it is no text.
    """
    return _read_rows(desc)[0]


def _read_rows(desc: object) -> tuple[tuple[str, ...], str]:
    """The rows, and what to call the map in an error message."""
    if isinstance(desc, str) and "\n" in desc:
        return tuple(desc.strip("\r\n").splitlines()), "the map"
    if isinstance(desc, str | os.PathLike):
        return tuple(_read_file(Path(desc)).strip("\r\n").splitlines()), f"the map {desc}"
    if isinstance(desc, Sequence) and all(isinstance(row, str) for row in desc):
        return tuple(desc), "the map"
    raise ValueError(
        f"desc must be a list of rows, such as ['S.', '#G'], or the path to a text file, not "
        f"{desc!r}"
    )


def _read_file(path: Path) -> str:
    try:
        return read_file(path, MAX_MAP_BYTES).decode("utf-8-sig")
    except OSError as error:
        reason = str(error.strerror)
    except UnsafeFileError as error:
        raise ValueError(f"desc: {error}") from error
    except UnicodeDecodeError:
        reason = "it is not a text file in UTF-8"
    raise ValueError(f"desc: cannot read the map file {path}: {reason}")


def _check_shape(rows: tuple[str, ...], source: str) -> None:
    if not rows or not rows[0]:
        raise ValueError(f"{source} is empty")
    n_columns = len(rows[0])
    if len(rows) * n_columns > MAX_STATES:
        raise ValueError(
            f"{source} has {len(rows)} rows of {n_columns} cells, more than {MAX_STATES:,} cells"
        )
    for row, cells in enumerate(rows, 1):
        if len(cells) != n_columns:
            where = min(len(cells), n_columns)
            raise ValueError(
                f"{source}: row {row} has {len(cells)} cells and row 1 has {n_columns}: they "
                f"differ from column {where + 1} on"
            )


def _check_letters(rows: tuple[str, ...], source: str, known: Collection[str]) -> None:
    for row, cells in enumerate(rows, 1):
        if not set(cells) <= set(known):
            column = next(column for column, letter in enumerate(cells) if letter not in known)
            raise ValueError(
                f"{source}: unknown letter {cells[column]!r} at row {row}, column {column + 1}; "
                f"known are {' '.join(known)}"
            )


def _only_start(codes: bytes, n_columns: int, source: str) -> int:
    first = codes.find(ord(START))
    if first < 0:
        raise ValueError(f"{source} has no start: mark it with the letter {START}")
    second = codes.find(ord(START), first + 1)
    if second >= 0:
        raise ValueError(
            f"{source} has two starts, at {_place(first, n_columns)} and at "
            f"{_place(second, n_columns)}; there must be one"
        )
    return first


def _place(cell: int, n_columns: int) -> str:
    row, column = divmod(cell, n_columns)
    return f"row {row + 1}, column {column + 1}"
