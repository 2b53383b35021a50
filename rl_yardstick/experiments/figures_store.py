"""Keeps the figures and curves of runs in one SQLite file for each agent and environment.

With ``--keep figures``, a study has these files instead of a folder for each run. A run still
trains in a folder. When it has ended, the driver writes its row, and removes the folder after the
commit. After a kill at any moment, a run is in its folder, in the file, or in both: if in both, the
row in the file counts.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import sqlite3
import struct
import time
import zlib
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.experiments.plan import PlannedRun, differences
from rl_yardstick.experiments.results import (
    RUN_COLUMNS,
    Curve,
    RunResults,
    read_run,
    speed_figures,
    tensors,
)
from rl_yardstick.experiments.run_folders import Differences, move_aside, move_to, new_folder
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.digests import LOCK, RECORD, DamagedFileError
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.files import files_below, plain
from rl_yardstick.pipeline.runs import PULLS_FILE

SUFFIX = ".sqlite"
KINDS = ("evaluation", "training")
ENDS = ("threshold", "stay")
POINTS = ("step", "episode", "seconds", "value")  # of a curve
_YARDSTICK = ("optimum", "baseline", "optimum_at_least")
TIMES = ("seconds", "cpu_seconds")  # these differ between two runs with the same seed
_NAMES = ("agent", "algo", "environment", "env_id", "seed", "engine", "path")
# These follow from the curve and the study's threshold, which may change.
_SPEED = ("threshold", *(f"{unit}_to_{end}" for unit in ("steps", "episodes") for end in ENDS))
FIGURES = tuple(name for name in RUN_COLUMNS if name not in (*_NAMES, *_SPEED))
_OF_ORIGIN = ("engine", "versions", "machine", "model_refused")  # the same in most runs
_COLUMNS = ("seed", "origin", *FIGURES, "curves", "model", "checksum")
_SCHEMA = {
    "about": "CREATE TABLE about (spec TEXT NOT NULL)",
    "origins": "CREATE TABLE origins (id INTEGER PRIMARY KEY, content TEXT NOT NULL UNIQUE)",
    "runs": f"CREATE TABLE runs (seed INTEGER PRIMARY KEY, {', '.join(_COLUMNS[1:])})",
    "kept": "CREATE TABLE kept (seed INTEGER PRIMARY KEY)",  # seeds whose folders stay
}
# A commit waits for the disk, so several runs share one. After a kill, they are still in folders.
SECONDS_BETWEEN_COMMITS = 1.0
MOST_WAITING = 500
_LARGEST_CURVE = 1 << 24  # bytes
WAYS_OUT = "put a copy of it back; or --repair moves it aside and does its runs again"


def store_path(planned: PlannedRun) -> Path:
    """The file of the runs of an agent on an environment, beside their folders."""
    return planned.path.with_name(planned.path.name.rpartition("_")[0] + SUFFIX)


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a file in autocommit mode; leaving without COMMIT changes nothing."""
    try:
        if path.is_symlink() or path.parent.is_symlink():
            raise DamagedFileError(path, "is a link, which is not followed")
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            yield database
    except UserError:
        raise
    except sqlite3.OperationalError as error:  # locked, or no room on the disk
        raise UserError(f"{path} cannot be used: {one_line(error)}") from error
    except (sqlite3.Error, ValueError, TypeError, KeyError, struct.error, zlib.error) as error:
        raise DamagedFileError(path, f"is damaged: {one_line(error)}; {WAYS_OUT}") from error


def _checked_seeds(path: Path) -> set[int]:
    """Read the seeds in a file, and check its tables and rows."""
    with _opened(path) as database:
        tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"))
        if not tables:  # killed before the first commit
            return set()
        if tables != _SCHEMA:
            raise ValueError("it has other tables")
        if database.execute("PRAGMA quick_check(1)").fetchone() != ("ok",):
            raise ValueError("its pages do not fit each other")
        origins = dict(database.execute("SELECT id, content FROM origins"))
        seeds = set()
        for seed, origin, *content, checksum in database.execute("SELECT * FROM runs"):
            if checksum != checksum_of(seed, origins[origin], content):
                raise ValueError(f"seed {seed} is not as it was written")
            seeds.add(seed)
        return seeds


def checksum_of(seed: int, origin: str, content: Sequence[Any]) -> int:
    """The checksum of a row; ``origin`` is the JSON text of its origin."""
    return zlib.crc32(repr((seed, origin, tuple(content))).encode())


# --- Curves as bytes.

_SCALES = (1.0, 1e6)  # whole numbers, and times in microseconds


def packed(columns: Sequence[Floats]) -> bytes:
    """Compress columns of numbers; `unpacked` restores them bit for bit."""
    codes, words = zip(
        *(_as_whole(np.ascontiguousarray(c, np.float64)) for c in columns), strict=True
    )
    heads = (struct.pack("<BI", *head) for head in zip(codes, map(len, columns), strict=True))
    # All first bytes of the numbers, then all second bytes, ...: similar neighbours compress well.
    planes = np.concatenate([word.view(np.uint8).reshape(-1, 8) for word in words]).T
    return zlib.compress(bytes([len(columns)]) + b"".join(heads) + planes.tobytes(), 9, -15)


def _as_whole(column: Floats) -> tuple[int, NDArray[Any]]:
    """The code of a scale that makes all numbers integers, and their differences; else 0."""
    for code, scale in enumerate(_SCALES, start=1):
        with np.errstate(over="ignore"):
            scaled = np.rint(column * scale)
        if np.abs(scaled).max(initial=0.0) < 2**53:  # False for NaN
            whole = scaled.astype(np.int64)
            if (whole / scale).tobytes() == column.tobytes():
                return code, np.diff(whole, prepend=0)
    return 0, column


def unpacked(content: bytes) -> list[Floats]:
    """Restore the columns from the bytes that `packed` returned."""
    inflated = zlib.decompressobj(-15).decompress(content, _LARGEST_CURVE)
    start = 1 + 5 * inflated[0]
    planes = np.frombuffer(inflated, np.uint8, offset=start).reshape(8, -1)
    words = np.ascontiguousarray(planes.T).view(np.int64).reshape(-1)
    columns, place = [], 0
    for code, n in struct.iter_unpack("<BI", inflated[1:start]):
        column, place = words[place : place + n], place + n
        columns.append(column.cumsum() / _SCALES[code - 1] if code else column.view(np.float64))
    return columns


# --- Runs as rows.


def _content_of(planned: PlannedRun, found: RunResults) -> tuple[str, list[Any]]:
    """The origin of a run, and its row between origin and checksum."""
    info, (row,) = planned.run.read_info(), found.rows
    origin = json.dumps(plain({key: info[key] for key in _OF_ORIGIN if key in info}))
    figures = [
        v.item() if isinstance(v, np.generic | np.ndarray) else v for v in map(row.get, FIGURES)
    ]
    by_kind = {curve.labels["kind"]: curve for curve in found.curves}
    curves = packed([by_kind[kind].figures[name] for kind in KINDS for name in POINTS])
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors(planned.run).items()):
        digest.update(f"{name} {len(tensor)}\n".encode() + tensor)
    # As SQLite returns them: it stores NaN as NULL, and booleans as integers.
    figures = [int(v) if isinstance(v, bool) else v for v in figures]
    figures = [None if isinstance(v, float) and math.isnan(v) else v for v in figures]
    return origin, [*figures, curves, digest.digest()[:16]]


def _without_times(content: Sequence[Any]) -> list[Any]:
    row = dict(zip((*FIGURES, "curves", "model"), content, strict=True))
    names = POINTS * len(KINDS)
    columns = zip(names, unpacked(row.pop("curves")), strict=True)
    figures = [value for name, value in row.items() if name not in TIMES]
    return [*figures, *(column.tobytes() for name, column in columns if name not in TIMES)]


def _is_single(planned: PlannedRun, found: RunResults) -> bool:
    """Whether a run can be stored: it is no batch, has no pulls, and its scale cannot change.

    In partially observable environments, the scale depends on the other agents of the study.
    """
    has_pulls = PULLS_FILE in (planned.run.files.digests or {})
    is_hidden = any(row.get("full_optimum") is not None for row in found.rows)
    return not (planned.is_batch or has_pulls or is_hidden)


def _is_our_own(planned: PlannedRun) -> bool:
    """Whether all files in the folder belong to the run."""
    names = {path.relative_to(planned.path).as_posix() for path in files_below(planned.path)}
    return names <= {*(planned.run.files.digests or {}), RECORD, LOCK}


@dataclass(frozen=True)
class StoredRuns:
    """The stored runs of an agent on an environment."""

    first: PlannedRun  # one of them
    seeds: list[int]  # ascending, with all stored seeds between the first and the last
    _speed: dict[str, list[Any]] = field(default_factory=dict)

    def __contains__(self, seed: int) -> bool:
        place = bisect_left(self.seeds, seed)
        return place < len(self.seeds) and self.seeds[place] == seed

    def _rows(self, columns: str, seeds: Sequence[int] | None = None) -> Iterator[Any]:
        """Columns of the runs from the first to the last of these seeds, ordered by seed.

        If the last column is ``curves``, unpacks it.
        """
        seeds = seeds or self.seeds
        query = f"SELECT {columns} FROM runs WHERE seed BETWEEN ? AND ? ORDER BY seed"  # noqa: S608
        with _opened(store_path(self.first)) as database:
            for row in database.execute(query, (seeds[0], seeds[-1])):
                yield (*row[:-1], unpacked(row[-1])) if columns.endswith("curves") else row

    def column(self, name: str, study: StudySpec) -> list[Any]:
        """A column of the summary, see `RUN_COLUMNS`."""
        spec, n = self.first.spec, len(self.seeds)
        if name in _SPEED:
            return self._speed_column(name, study)
        if name == "path":
            stem = str(self.first.path).rpartition("_")[0]
            return [f"{stem}_{seed + 1}" for seed in self.seeds]
        if name == "engine":
            engines = {key: one.get("engine") for key, one in self._origins().items()}
            return [engines[key] for (key,) in self._rows("origin")]
        if name in _NAMES:
            labels = {"agent": self.first.agent, "environment": self.first.environment}
            same = {**labels, "algo": spec.algo, "env_id": spec.env_id}
            return self.seeds if name == "seed" else [same[name]] * n
        values = [value for (value,) in self._rows(name)]
        return [None if v is None else bool(v) for v in values] if name == "exact" else values

    def _speed_column(self, name: str, study: StudySpec) -> list[Any]:
        if not self._speed:  # all at once: most of the time goes into unpacking the curves
            self._speed.update({column: [] for column in _SPEED})
            for *final, columns in self._rows(", ".join((*_YARDSTICK, "curves"))):
                known = {k: v for k, v in zip(_YARDSTICK, final, strict=True) if v is not None}
                curve = dict(zip(POINTS, columns, strict=False))  # of evaluations
                found = speed_figures(study, self.first.spec.env_id, known, curve)
                for column in _SPEED:
                    self._speed[column].append(found[column])
        return self._speed.pop(name)

    def curves(self, seeds: Sequence[int] | None = None) -> Iterator[list[Curve]]:
        """The evaluation and the training curve of each run with these seeds; by default of all."""
        labels = {"agent": self.first.agent, "environment": self.first.environment}
        for seed, unpacked_curves in self._rows("seed, curves", seeds):
            columns = iter(unpacked_curves)
            yield [
                Curve(
                    {**labels, "seed": seed, "kind": kind}, dict(zip(POINTS, columns, strict=False))
                )
                for kind in KINDS
            ]

    def content(self, seed: int) -> list[Any]:
        """The row of a run, without seed, origin and checksum."""
        return list(next(self._rows("*", [seed]))[2:-1])

    def infos(self) -> list[dict[str, Any]]:
        """The settings and versions in ``run.json``, once for each group of equal ones.

        ``n_runs`` is the size of the group.
        """
        origins = self._origins()
        with _opened(store_path(self.first)) as database:
            (spec,) = database.execute("SELECT spec FROM about").fetchone()
            ends = self.seeds[0], self.seeds[-1]
            rows = database.execute(
                "SELECT origin, n_timesteps, COUNT(*) FROM runs WHERE seed BETWEEN ? AND ? "
                "GROUP BY origin, n_timesteps ORDER BY MIN(seed)",
                ends,
            )
            shared = json.loads(spec)
            return [
                {**origins[key], "spec": shared, "n_timesteps": steps, "n_runs": n}
                for key, steps, n in rows
            ]

    def _origins(self) -> dict[int, dict[str, Any]]:
        with _opened(store_path(self.first)) as database:
            rows = database.execute("SELECT id, content FROM origins")
            return {key: json.loads(content) for key, content in rows}


class FigureStore:
    """The stored runs of a study.

    Args:
        folds: whether runs that end are stored, and their folders removed.
        first_seed: the seed whose folders stay, because the page shows these runs.
    """

    def __init__(self, *, folds: bool = False, first_seed: int = 0) -> None:
        self.folds, self.first_seed = folds, first_seed
        self._seeds: dict[tuple[str, str], set[int]] = {}
        self._waiting: list[tuple[PlannedRun, str, list[Any]]] = []
        self._last_commit = time.monotonic()

    def holds(self, planned: PlannedRun) -> bool:
        """Whether a run is stored.

        Raises:
            DamagedFileError: if the file is damaged.
        """
        return not planned.is_batch and planned.seed in self._seeds_of(planned)

    def _seeds_of(self, planned: PlannedRun) -> set[int]:
        if planned.labels not in self._seeds:
            path = store_path(planned)
            there = path.is_symlink() or path.exists()
            self._seeds[planned.labels] = _checked_seeds(path) if there else set()
        return self._seeds[planned.labels]

    def runs(self, planned: Sequence[PlannedRun]) -> dict[tuple[str, str], StoredRuns]:
        """The stored runs among ``planned`` by labels; ``planned`` is ordered by seed."""
        found: dict[tuple[str, str], StoredRuns] = {}
        for run in planned:
            if self.holds(run):
                found.setdefault(run.labels, StoredRuns(run, [])).seeds.append(run.seed)
        return found

    def add(self, planned: PlannedRun, found: RunResults | None) -> bool:
        """Queue a finished run to be stored instead of its folder; returns whether it is queued."""
        with suppress(DamagedFileError, OSError):  # damage is reported when all runs are read
            planned = planned.read()
            stays = planned.seed == self.first_seed
            if (
                self.folds
                and found is not None
                and _is_single(planned, found)
                and (stays or _is_our_own(planned))
            ):
                self._waiting.append((planned, *_content_of(planned, found)))
                now = time.monotonic()
                if (
                    now - self._last_commit > SECONDS_BETWEEN_COMMITS
                    or len(self._waiting) >= MOST_WAITING
                ):
                    self.commit()
                return True
        return False

    def commit(self) -> None:
        """Store the queued runs, and remove their folders."""
        by_file: dict[Path, list[tuple[PlannedRun, str, list[Any]]]] = {}
        for one in self._waiting:
            by_file.setdefault(store_path(one[0]), []).append(one)
        for path, rows in by_file.items():
            with _opened(path) as database:
                database.execute("BEGIN IMMEDIATE")
                _write(database, rows, self.first_seed)
                database.execute("COMMIT")
            for planned, *_ in rows:
                self._seeds_of(planned).add(planned.seed)
                if planned.seed != self.first_seed:
                    shutil.rmtree(planned.path, ignore_errors=True)
        self._waiting.clear()
        self._last_commit = time.monotonic()

    def tidy(self, planned: Sequence[PlannedRun]) -> None:
        """Remove the folders of stored runs that a kill has left, except those that are kept."""
        if not self.folds:
            return
        for labels, runs in self.runs(planned).items():
            path, seeds = store_path(runs.first), self._seeds[labels]
            with _opened(path) as database:
                kept = {seed for (seed,) in database.execute("SELECT seed FROM kept")}
            for folder in path.parent.glob(f"{path.stem}_*"):
                number = folder.name.removeprefix(f"{path.stem}_")
                if number.isdecimal() and int(number) - 1 in seeds - kept:
                    shutil.rmtree(folder, ignore_errors=True)

    def keep(self, planned: PlannedRun) -> None:
        """Note that the folder of a stored run stays."""
        with _opened(store_path(planned)) as database:
            database.execute("INSERT OR IGNORE INTO kept VALUES (?)", (planned.seed,))

    def is_again(self, study: StudySpec, planned: PlannedRun) -> bool:
        """Whether a run in its folder equals the stored run bit for bit, except for times."""
        found = read_run(study, planned)
        if found is None:
            return False
        there = StoredRuns(planned, [planned.seed]).content(planned.seed)
        return _without_times(there) == _without_times(_content_of(planned, found)[1])

    def differences(
        self, planned: Sequence[PlannedRun]
    ) -> list[tuple[PlannedRun, int, Differences]]:
        """For each file with other settings: one run, the number of stored runs, differences."""
        found = []
        for run in {run.labels: run for run in planned}.values():
            if not run.is_batch and (seeds := self._seeds_of(run)):
                (info, *_) = StoredRuns(run, sorted(seeds)).infos()
                there = differences(info["spec"], run.spec)
                there.pop("seed", None)
                found += [(run, len(seeds), there)] if there else []
        return found

    def move_others_aside(self, planned: Sequence[PlannedRun], root: Path) -> None:
        """Move files of runs with other settings to ``replaced/<number>``."""
        others = self.differences(planned)
        place = new_folder(root) if others else root
        for run, *_ in others:
            move_to(place, store_path(run), root)
            self._seeds[run.labels] = set()

    def move_damaged_aside(self, planned: Sequence[PlannedRun]) -> list[Path]:
        """Rename damaged files; returns their new paths."""
        moved = []
        for run in {run.labels: run for run in planned}.values():
            try:
                self._seeds_of(run)
            except DamagedFileError:
                moved.append(move_aside(store_path(run)))
                # SQLite would apply the journal to the next file of this name.
                store_path(run).with_suffix(f"{SUFFIX}-journal").unlink(missing_ok=True)
        return moved


def _write(
    database: sqlite3.Connection, rows: Sequence[tuple[PlannedRun, str, list[Any]]], first_seed: int
) -> None:
    if not database.execute("SELECT 1 FROM sqlite_master").fetchone():
        for table in _SCHEMA.values():
            database.execute(table)
        spec = json.dumps(plain(rows[0][0].spec.as_data()))
        database.execute("INSERT INTO about VALUES (?)", (spec,))
    for planned, origin, content in rows:
        database.execute("INSERT OR IGNORE INTO origins (content) VALUES (?)", (origin,))
        key = "SELECT id FROM origins WHERE content = ?"
        (number,) = database.execute(key, (origin,)).fetchone()
        row = [planned.seed, number, *content, checksum_of(planned.seed, origin, content)]
        database.execute(_insertion(), row)
        if planned.seed == first_seed:
            database.execute("INSERT OR IGNORE INTO kept VALUES (?)", (planned.seed,))


@cache
def _insertion() -> str:
    return f"INSERT OR IGNORE INTO runs VALUES ({', '.join('?' * len(_COLUMNS))})"  # noqa: S608
