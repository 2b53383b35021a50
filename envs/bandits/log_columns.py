"""The columns of a CSV file of logged pulls, read in pieces and held against their limits.

What is kept are numbers: as texts, a file of some hundred megabytes would take gigabytes.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from envs.bandits.bandit import MAX_ARMS
from mdp.array_types import Bools, Floats, Ints
from safe_files.files import UnsafeFileError, opened

ARM, REWARD, PROPENSITY = "arm", "reward", "propensity"

MAX_BYTES = 1 << 30
# An arm's linear model of the context takes its square in numbers.
MAX_COLUMNS = 1000
# Squares of numbers beyond these no longer are numbers, nor are the weights of rarer pulls.
MAX_NUMBER, MIN_PROPENSITY = 1e15, 1e-9
# Characters of a row; a thousand numbers take a tenth of that.
MAX_ROW = 1 << 20
MAX_CATEGORIES = 1_000_000
ROWS_AT_ONCE = 10_000
LONGEST_SHOWN, MOST_SHOWN = 60, 12  # characters of a name, and names, in a message
NUMBER = "a finite number of no more than 1e15"


def read_columns(path: Path) -> tuple[dict[str, Floats], Words | None]:
    """The columns of a file as numbers; and as words, where text is all of the context.

    Raises:
        ValueError: if the file cannot be read, or is no such log; see `read_log`.
    """
    try:
        with opened(path, MAX_BYTES) as binary:
            lines = _BoundedLines(TextIOWrapper(binary, encoding="utf-8-sig", newline=""))
            return _read_columns(path, _rows(path, lines))
    except (OSError, UnicodeDecodeError, csv.Error, UnsafeFileError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ValueError(f"cannot read {path}: {reason}") from error


class _BoundedLines:
    """The lines of a file, of which no row may take too much: a line may go on for gigabytes."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.room = MAX_ROW

    def __iter__(self) -> Iterator[str]:
        while line := self._file.readline(MAX_ROW + 1):
            self.room -= len(line)
            if self.room < 0:
                raise csv.Error(f"a row has more than {MAX_ROW:,} characters")
            yield line


def _rows(path: Path, lines: _BoundedLines) -> Iterator[tuple[int, list[str]]]:
    """The header, and each row below it, which has as many cells; each with its line."""
    reader = csv.reader(lines, strict=True)
    n_cells = None
    for row in reader:
        lines.room = MAX_ROW
        if not row:
            continue
        cells = [cell.strip() for cell in row]
        if n_cells is None:
            _check_header(cells, path)
            n_cells = len(cells)
        if len(cells) != n_cells:
            raise ValueError(
                f"{path}, line {reader.line_num} has {len(cells)} values, not {n_cells}"
            )
        yield reader.line_num, cells


def _read_columns(
    path: Path, rows: Iterator[tuple[int, list[str]]]
) -> tuple[dict[str, Floats], Words | None]:
    header = [name for _, cells in islice(rows, 1) for name in cells]
    names = [name for name in header if name not in _WANTED]
    words = Words(f"{path}", names[0]) if len(names) == 1 else None
    pieces: dict[str, list[Floats]] = {name: [] for name in header}
    while piece := list(islice(rows, ROWS_AT_ONCE)):
        lines = [line for line, _ in piece]
        for name, texts in zip(
            header, zip(*(cells for _, cells in piece), strict=True), strict=True
        ):
            values = _as_floats(texts)
            if words is not None and name == words.name:
                words.add(lines, texts, values)
            else:
                _check_numbers(f"{path}, line", name, lines, texts, values)
            pieces[name].append(values)
    if not (header and pieces[ARM]):
        raise ValueError(f"{path} holds no pulls: a header and a row for each are needed")
    columns = {name: np.concatenate(values) for name, values in pieces.items()}
    return columns, None if words is None or words.are_numbers() else words


class Words:
    """The cells of a column that is all of the context: text in all rows, or numbers in all."""

    def __init__(self, path: str, name: str) -> None:
        self.name = name
        self._path = path
        self._numbers: dict[str, int] = {}
        self._codes: list[Ints] = []
        self._any_number = False
        self._mistake: ValueError | None = None

    def add(self, lines: list[int], texts: tuple[str, ...], values: Floats) -> None:
        """Take in some rows."""
        self._any_number |= not np.isnan(values).all()
        if self._mistake is None:
            try:
                _check_numbers(f"{self._path}, line", self.name, lines, texts, values)
            except ValueError as error:
                self._mistake = error
        if self._any_number:
            self._numbers.clear()
            self._codes.clear()
            return
        known = self._numbers
        self._codes.append(np.array([known.setdefault(text, len(known)) for text in texts]))
        if len(known) > MAX_CATEGORIES:
            raise ValueError(
                f"{self._path}: {self.name} has more than {MAX_CATEGORIES:,} values of text"
            )

    def are_numbers(self) -> bool:
        """Whether all cells are numbers.

        Raises:
            ValueError: if some are, and others are not.
        """
        if self._any_number and self._mistake is not None:
            raise self._mistake
        return self._any_number

    @property
    def sorted(self) -> tuple[str, ...]:
        """The texts in alphabetical order."""
        return tuple(sorted(self._numbers))

    def places(self) -> Ints:
        """The place of each row's text among `sorted`, shape (n,)."""
        rank = np.empty(len(self._numbers), np.int64)
        rank[[self._numbers[text] for text in self.sorted]] = np.arange(len(rank))
        return rank[np.concatenate(self._codes)]


def _check_numbers(
    where: str, name: str, lines: list[int], texts: tuple[str, ...], values: Floats
) -> None:
    """Make sure that numbers are valid, and of a size to reckon with."""
    wanted, valid = _WANTED.get(name, _CONTEXT)
    wrong = np.flatnonzero(~((np.abs(values) <= MAX_NUMBER) & valid(values)))
    if len(wrong):
        line, text = lines[wrong[0]], texts[wrong[0]]
        shown = text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."
        raise ValueError(f"{where} {line}: {name} is {shown!r}, it must be {wanted}")


def _check_header(header: list[str], path: Path) -> None:
    if len(header) > MAX_COLUMNS:
        raise ValueError(f"{path} has {len(header):,} columns, more than {MAX_COLUMNS:,}")
    for name in (ARM, REWARD) if header else ():
        if name not in header:
            raise ValueError(f"{path} has no column {name!r}, only {some(header)}")
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"{path} has two columns {twice[:LONGEST_SHOWN]!r}")


def some(names: Sequence[str]) -> str:
    """The first of some names, as a message lists them."""
    text = ", ".join(name[:LONGEST_SHOWN] for name in names[:MOST_SHOWN])
    return text if len(names) <= MOST_SHOWN else f"{text} and {len(names) - MOST_SHOWN:,} more"


def _as_floats(texts: Iterable[str]) -> Floats:
    """Each text as a number, NaN where it is none."""

    def number(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            return math.nan

    return np.fromiter(map(number, texts), np.float64)


def _is_arm(values: Floats) -> Bools:
    is_arm: Bools = (values >= 0) & (values < MAX_ARMS) & (values == np.floor(values))
    return is_arm


def _is_propensity(values: Floats) -> Bools:
    return (values >= MIN_PROPENSITY) & (values <= 1)


# What a column must hold: in words, and of numbers.
_CONTEXT = f"{NUMBER}: text can only be all of the context", np.isfinite
_WANTED: Mapping[str, tuple[str, Callable[[Floats], Bools]]] = {
    ARM: (f"a whole number from 0 to {MAX_ARMS - 1}", _is_arm),
    REWARD: (NUMBER, np.isfinite),
    PROPENSITY: (f"a probability from {MIN_PROPENSITY} to 1", _is_propensity),
}
