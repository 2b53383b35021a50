"""Counts the looks at a study (interim analyses of its runs), and assigns error rates to them.

At most ``ALPHA`` of the studies contain a wrong claim: each environment, and all of them together,
have a share of this rate. Looks are counted separately for each environment.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from experiments.study import METRICS, StudySpec
from pipeline.errors import UserError, one_line
from pipeline.files import write_json
from safe_files.files import UnsafeFileError, read_file
from verdicts import level_of_look

ALPHA = 0.05  # the largest share of studies with a wrong claim


@dataclass(frozen=True)
class Question:
    """The question of a look; another question about the same runs is another look."""

    metric: str  # the metric of the verdicts
    # Difference within which agents are equivalent; None for the default share of the gap between
    # the best random or constant policy and the optimum.
    margin: float | None
    threshold: float | None  # return that counts as solved; None for the default
    first_seed: int  # the first seed
    shared_randomness: bool  # whether agents are compared seed by seed


@dataclass(frozen=True)
class Look:
    """One look at the runs on an environment."""

    date: str  # date of the look, for readers
    question: Question  # the question
    seeds: Mapping[str, int]  # by agent, the number of seeds
    runs: Mapping[str, int]  # by agent, the number of seeds with a figure
    digests: Mapping[str, str]  # by agent, the digest of these figures
    level: float  # its error rate
    planned: bool  # whether it belongs to a design

    def shows(self, other: Look) -> bool:
        """Whether this look already used the same runs, or more runs of the same seeds."""
        return (
            (self.question, dict(self.seeds)) == (other.question, dict(other.seeds))
            and self.runs.keys() == other.runs.keys()
            and all(self.runs[name] >= other.runs[name] for name in other.runs)
            and all(
                self.digests[name] == other.digests[name]
                for name in other.runs
                if self.runs[name] == other.runs[name]
            )
        )


@dataclass(frozen=True)
class Design:
    """Looks that were planned before the first of them; together they count as one look."""

    question: Question  # the question
    sizes: tuple[int, ...]  # the seeds of a growing agent at each look
    seeds: Mapping[str, int]  # by agent, its current or next number of seeds
    after: int  # number of earlier looks outside the design

    @property
    def level(self) -> float:
        """The error rate of all looks of the design together."""
        return level_of_look(ALPHA, self.after + 1)

    @property
    def share(self) -> float:
        """The error rate of each look."""
        return level_of_look(self.level, 1, len(self.sizes))


@dataclass(frozen=True)
class Looks:
    """All looks at the runs on an environment."""

    taken: tuple[Look, ...] = ()  # the looks in order of time
    design: Design | None = None  # the planned looks, if any

    @property
    def planned(self) -> tuple[Look, ...]:
        """The looks of the design that were taken."""
        return tuple(look for look in self.taken if look.planned)

    @property
    def next_level(self) -> float:
        """The error rate of the next look outside a design."""
        return self._unplanned_level(self.taken)

    def level_at(self, place: int) -> float:
        """The error rate of the look at an index of ``taken``."""
        if not self.taken[place].planned:
            return self._unplanned_level(self.taken[:place])
        if self.design is None:
            raise ValueError("no looks were settled")
        return self.design.share

    def _unplanned_level(self, before: Sequence[Look]) -> float:
        """The error rate of an unplanned look; the design counts as one look."""
        n_before = sum(not look.planned for look in before)
        with_design = self.design is not None and self.design.after <= n_before
        return level_of_look(ALPHA, n_before + with_design + 1)


LookLog = Mapping[str, Looks]  # all looks at a study, by environment


@dataclass(frozen=True)
class Standing:
    """The place of a look among all looks at the runs on an environment."""

    number: int = 1  # number of the look, counted from 1
    level: float = level_of_look(ALPHA, 1)  # its error rate
    next_level: float = level_of_look(ALPHA, 2)  # error rate of the next look
    # The design to which it belongs, or None.
    design: Design | None = None
    is_counted: bool = True  # False if there are too few runs for any claim


def question_of(study: StudySpec) -> Question:
    """The question of a study."""
    return Question(
        study.metric, study.margin, study.threshold, study.first_seed, study.shared_randomness
    )


# --- The file of looks in the folder of a study.

LOOKS_FILE = "looks.json"
_FORMAT, _ABOUT_TYPICAL_RUNS = 2, 1
_LARGEST = 50_000_000  # bytes; a hundred looks at a thousand agents take less
_LARGEST_NUMBER = 1e300


def write_looks(root: Path, log: LookLog) -> None:
    """Replace the file atomically, and flush it to disk."""
    looks = {name: asdict(each) for name, each in log.items()}
    write_json(root / LOOKS_FILE, {"format": _FORMAT, "environments": looks})


def read_looks(root: Path) -> LookLog:
    """Read the looks at a study; empty without a file.

    Raises:
        UserError: if the file is damaged, so that the number of looks is unknown.
    """
    path = root / LOOKS_FILE
    try:
        data = json.loads(read_file(path, _LARGEST))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    except UnsafeFileError as error:
        raise _wrong(path, str(error).removeprefix(f"{path} ")) from error
    except (ValueError, RecursionError) as error:
        raise _wrong(path, "it is no JSON") from error
    if isinstance(data, dict) and data.get("format") == _ABOUT_TYPICAL_RUNS:
        raise UserError(
            f"{path} was written by an earlier version, whose verdicts were not about means: give "
            "the study another name, or remove the file: then the looks at this study are forgotten"
        )
    try:
        return _log(data)
    except _MisfitError as error:
        raise _wrong(path, f"{error} is not as it was written") from error


def _wrong(path: Path, reason: str) -> UserError:
    return UserError(
        f"{path} is damaged: {reason}; put a copy of it back, or remove it: then the looks at this "
        "study are forgotten"
    )


class _MisfitError(Exception):
    """Data do not match a dataclass; the text says where."""


def _read_as(kind: Any, data: Any, where: str) -> Any:
    """Convert plain data to a dataclass with exactly these fields and types.

    Integers must be at least 0, and all numbers finite; otherwise raises `_MisfitError`.
    """
    arguments = get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        kinds = get_type_hints(kind)
        if not isinstance(data, dict) or data.keys() != kinds.keys():
            raise _MisfitError(where)
        return kind(**{key: _read_as(kinds[key], data[key], f"{where}: {key}") for key in kinds})
    if NoneType in arguments:
        return None if data is None else _read_as(arguments[0], data, where)
    if get_origin(kind) is tuple and isinstance(data, list):
        return tuple(_read_as(arguments[0], each, where) for each in data)
    if get_origin(kind) is Mapping and isinstance(data, dict):
        return {key: _read_as(arguments[1], each, where) for key, each in data.items()}
    is_bool, is_number = isinstance(data, bool), isinstance(data, int | float)
    fits = {
        str: isinstance(data, str),
        bool: is_bool,
        int: isinstance(data, int) and not is_bool and data >= 0,
        float: is_number and not is_bool and -_LARGEST_NUMBER < data < _LARGEST_NUMBER,
    }
    if not fits.get(kind, False):
        raise _MisfitError(where)
    return data


def _log(data: Any) -> LookLog:
    is_whole = isinstance(data, dict) and data.keys() == {"format", "environments"}
    if not is_whole or data["format"] != _FORMAT or not isinstance(data["environments"], dict):
        raise _MisfitError("the whole")
    return {name: _looks(each, name) for name, each in data["environments"].items()}


def _looks(data: Any, where: str) -> Looks:
    """Read the looks on an environment; detects a removed or inserted look."""

    def check(is_right: bool, what: str) -> None:
        if not is_right:
            raise _MisfitError(f"{where}: {what}")

    if not isinstance(data, dict) or data.keys() != {"taken", "design"}:
        raise _MisfitError(where)
    check(isinstance(data["taken"], list), "taken")
    design: Design | None = _read_as(Design | None, data["design"], f"{where}: design")
    if design is not None:
        sizes, seeds = design.sizes, set(design.seeds.values())
        is_rising = sizes == tuple(sorted(set(sizes))) and min(sizes, default=0) > 0
        check(is_rising, "design: sizes")
        check(seeds <= set(sizes), "design: seeds")
        check(design.question.metric in METRICS, "design: question: metric")
    taken: list[Look] = []
    for place, each in enumerate(data["taken"], start=1):
        look: Look = _read_as(Look, each, f"{where}: look {place}")
        agents = look.seeds.keys()
        check(agents == look.runs.keys() == look.digests.keys(), f"look {place}: the agents")
        check(look.question.metric in METRICS, f"look {place}: question: metric")
        taken.append(look)
    looks = Looks(tuple(taken), design)
    n_planned, sizes = len(looks.planned), () if design is None else design.sizes
    check(n_planned <= len(sizes), "the number of planned looks")
    if design is not None:
        are_same = all(look.seeds.keys() == design.seeds.keys() for look in looks.planned)
        check(are_same, "the agents of planned looks")
        check(design.after <= len(taken) - n_planned, "the number of looks before the design")
    for place, look in enumerate(taken):
        is_level = math.isclose(look.level, looks.level_at(place), rel_tol=1e-9)
        check(is_level, f"the level of look {place + 1}")
    return looks
