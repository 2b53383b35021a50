"""What was shown to whom, and what came of it: logged pulls in a CSV file.

Each row is one pull, under a header with the columns ``arm``, ``reward`` and, if it is known with
what probability the arm was chosen, ``propensity``. Every other column is part of the context.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.bandits.bandit import MAX_ARMS
from mdp.array_types import Bools, Floats, Ints
from safe_files.refusals import UnsafeFileError
from safe_files.regular_files import opened

ARM, REWARD, PROPENSITY = "arm", "reward", "propensity"

MAX_BYTES = 1 << 30
# An arm's linear model of the context takes its square in numbers.
MAX_COLUMNS = 1000
# Squares of numbers beyond these no longer are numbers, nor are the weights of rarer pulls.
MAX_NUMBER, MIN_PROPENSITY = 1e15, 1e-9
NUMBER = "a finite number of no more than 1e15"


@dataclass(frozen=True, eq=False)
class LoggedData:
    """Pulls that somebody else made, in the order of the file.

    Attributes:
        source: the file, for messages.
        context_names: the columns that make up the context, d of them.
        contexts: what was known before each pull, shape (n, d). Text is given as its place in
            ``categories``.
        arms: the arms pulled, int64 of shape (n,).
        rewards: what they gave, shape (n,).
        propensities: the probability with which each was chosen, shape (n,); None if not known.
        categories: the values of a context of text, in alphabetical order; None for numbers.
    """

    source: str
    context_names: tuple[str, ...]
    contexts: Floats
    arms: Ints
    rewards: Floats
    propensities: Floats | None
    categories: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.arms)

    @property
    def n_arms(self) -> int:
        """One more than the highest arm that was pulled."""
        return int(self.arms.max()) + 1

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The space of the contexts.

        Discrete for no context, for one column of text, and for one that holds every whole number
        from 0 to its largest; otherwise a Box with the bounds of each column.
        """
        if not self.context_names:
            return spaces.Discrete(1)
        if self.categories is not None:
            return spaces.Discrete(len(self.categories))
        if len(self.context_names) == 1:
            values = np.unique(self.contexts)
            if np.array_equal(values, np.arange(len(values))):
                return spaces.Discrete(len(values))
        rounded = self.contexts.astype(np.float32)
        return spaces.Box(rounded.min(axis=0), rounded.max(axis=0), dtype=np.float32)

    def observations(self, space: spaces.Space[Any]) -> NDArray[Any]:
        """The contexts as an agent with a certain observation space is shown them.

        Args:
            space: Discrete, or a Box of one axis.

        Returns:
            int64 of shape (n,) for Discrete, float32 of shape (n, d) for a Box.

        Raises:
            ValueError: if the contexts do not fit into the space.
        """
        if isinstance(space, spaces.Discrete):
            return self._as_discrete(int(space.n))
        n_columns = len(self.context_names)
        if not isinstance(space, spaces.Box) or space.shape != (n_columns,) or self.categories:
            raise ValueError(f"{self.source} has {self._described()}, the agent observes {space}")
        return self.contexts.astype(np.float32)

    def _as_discrete(self, n_contexts: int) -> Ints:
        if n_contexts == 1 and not self.context_names:
            return np.zeros(len(self), np.int64)
        codes = self.contexts.astype(np.int64)
        fits = len(self.context_names) == 1 and np.array_equal(codes, self.contexts)
        if self.categories is not None:
            fits = len(self.categories) == n_contexts
        if not fits or codes.min() < 0 or codes.max() >= n_contexts:
            wanted = f"one column of whole numbers from 0 to {n_contexts - 1}"
            raise ValueError(f"{self.source} has {self._described()}, the agent observes {wanted}")
        return codes[:, 0]

    def _described(self) -> str:
        """The contexts in words."""
        if not self.context_names:
            return "no context"
        names = ", ".join(self.context_names)
        if self.categories is None:
            return f"the context {names}"
        return f"the context {names} with {len(self.categories)} values of text"


def read_log(path: str | Path) -> LoggedData:
    """Read logged pulls.

    Args:
        path: a CSV file, separated by commas, with a header; see the module.

    Raises:
        ValueError: if it cannot be read, a column is missing or there twice, a row is too short or
            too long, an arm is not a whole number from 0, a number not finite or beyond 1e15, or a
            propensity not from 1e-9 to 1. The message names file and line.
    """
    table = _Table.read(Path(path))
    names = tuple(name for name in table.columns if name not in {ARM, REWARD, PROPENSITY})
    text = len(names) == 1 and bool(np.isnan(_as_floats(table.columns[names[0]])).all())
    categories = tuple(sorted(set(table.columns[names[0]]))) if text else None
    contexts = np.empty((len(table.lines), len(names)))
    if categories is not None:
        place = {value: i for i, value in enumerate(categories)}
        contexts[:, 0] = [place[value] for value in table.columns[names[0]]]
    else:
        for i, name in enumerate(names):
            contexts[:, i] = table.numbers(name, f"{NUMBER}: text can only be all of the context")
    whole = f"a whole number from 0 to {MAX_ARMS - 1}"
    arms = table.numbers(ARM, whole, lambda v: (v >= 0) & (v < MAX_ARMS) & (v == np.floor(v)))
    propensities = None
    if PROPENSITY in table.columns:
        above = f"a probability from {MIN_PROPENSITY} to 1"
        propensities = table.numbers(PROPENSITY, above, lambda v: (v >= MIN_PROPENSITY) & (v <= 1))
    return LoggedData(
        source=str(path),
        context_names=names,
        contexts=contexts,
        arms=arms.astype(np.int64),
        rewards=table.numbers(REWARD, NUMBER),
        propensities=propensities,
        categories=categories,
    )


def log_uniformly(env: gym.Env[Any, Any], n: int, seed: int, path: str | Path) -> None:
    """Pull arms uniformly at random and write what came of it, for `read_log` to read.

    Args:
        env: a bandit as `gymnasium.make` returns it; its observations are Discrete, or a Box of
            one axis.
        n: the number of pulls; episodes follow each other where one is too short.
        seed: of the environment and of the arms.
        path: the file to write.
    """
    assert isinstance(env.action_space, spaces.Discrete)
    n_arms = int(env.action_space.n)
    # A stream of its own: the environment draws from that of the seed itself.
    arms = np.random.default_rng([seed, 1]).integers(n_arms, size=n).tolist()
    space = env.observation_space
    if isinstance(space, spaces.Discrete):
        names = ["context"] if space.n > 1 else []
    else:
        assert isinstance(space, spaces.Box)
        names = [f"feature_{i}" for i in range(space.shape[0])]
    context, _ = env.reset(seed=seed)
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*names, ARM, REWARD, PROPENSITY])
        for arm in arms:
            shown = np.ravel(context).tolist()[: len(names)]
            context, reward, terminated, truncated, _ = env.step(arm)
            writer.writerow([*shown, arm, reward, 1 / n_arms])
            if terminated or truncated:
                context, _ = env.reset()


@dataclass(frozen=True, eq=False)
class _Table:
    """The cells of a CSV file by column, and the line of the file that each row stands on."""

    path: Path
    lines: list[int]
    columns: dict[str, tuple[str, ...]]

    @classmethod
    def read(cls, path: Path) -> _Table:
        """Split a file into cells, and check that it has the columns it must have."""
        try:
            with opened(path, MAX_BYTES) as binary:
                file = TextIOWrapper(binary, encoding="utf-8-sig", newline="")
                reader = csv.reader(file, strict=True)
                numbered = ((reader.line_num, row) for row in reader if row)
                return cls._of_rows(path, numbered)
        except (OSError, UnicodeDecodeError, csv.Error, UnsafeFileError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise ValueError(f"cannot read {path}: {reason}") from error

    @classmethod
    def _of_rows(cls, path: Path, numbered: Iterator[tuple[int, list[str]]]) -> _Table:
        """The table of a header and the rows below it, each with its line."""
        header = [name.strip() for _, row in islice(numbered, 1) for name in row]
        _check_header(header, path)
        lines: list[int] = []
        columns: list[list[str]] = [[] for _ in header]
        for line, row in numbered:
            if len(row) != len(header):
                raise ValueError(f"{path}, line {line} has {len(row)} values, not {len(header)}")
            lines.append(line)
            for column, cell in zip(columns, row, strict=True):
                column.append(cell.strip())
        if not lines:
            raise ValueError(f"{path} holds no pulls: a header and a row for each are needed")
        return cls(path, lines, dict(zip(header, map(tuple, columns), strict=True)))

    def numbers(
        self, name: str, wanted: str, valid: Callable[[Floats], Bools] = np.isfinite
    ) -> Floats:
        """A column as numbers, all of them of a size to reckon with and valid."""
        values = _as_floats(self.columns[name])
        wrong = np.flatnonzero(~((np.abs(values) <= MAX_NUMBER) & valid(values)))
        if len(wrong):
            line, value = self.lines[wrong[0]], self.columns[name][wrong[0]]
            raise ValueError(f"{self.path}, line {line}: {name} is {value!r}, it must be {wanted}")
        return values


def _check_header(header: list[str], path: Path) -> None:
    if len(header) > MAX_COLUMNS:
        raise ValueError(f"{path} has {len(header):,} columns, more than {MAX_COLUMNS:,}")
    for name in (ARM, REWARD) if header else ():
        if name not in header:
            raise ValueError(f"{path} has no column {name!r}, only {', '.join(header)}")
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"{path} has two columns {twice!r}")


def _as_floats(texts: Iterable[str]) -> Floats:
    """Each text as a number, NaN where it is none."""

    def number(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            return math.nan

    return np.fromiter(map(number, texts), np.float64)
