"""How often a study has been looked at, and what each look may spend of the error rate.

At most ``ALPHA`` of the studies say anything wrong: each environment, and all of them together, may
spend its share. Looks are counted for each environment by itself.
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

ALPHA = 0.05  # of the studies, at most, say anything wrong


@dataclass(frozen=True)
class Question:
    """What the runs were asked; another question is another look at them."""

    metric: str  # what verdicts are about
    # Difference within which agents are equivalent; None for the usual share of the way from the
    # best random or constant policy to the optimum.
    margin: float | None
    threshold: float | None  # return that counts as solved; None for the usual
    first_seed: int  # the first seed
    shared_randomness: bool  # whether agents are compared seed by seed


@dataclass(frozen=True)
class Look:
    """One look at the runs on an environment."""

    date: str  # when it was, for readers
    question: Question  # what was asked
    seeds: Mapping[str, int]  # by agent, with how many seeds
    runs: Mapping[str, int]  # by agent, of how many of them there was a figure
    digests: Mapping[str, str]  # by agent, of these figures
    level: float  # the error rate that it spent
    planned: bool  # whether it is one of those that were settled before the first

    def shows(self, other: Look) -> bool:
        """Whether this look showed what another would: the same runs, or more of those seeds."""
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
    """Looks that were settled before the first of them: they share the level of one."""

    question: Question  # what is asked
    sizes: tuple[int, ...]  # how many seeds a growing agent has at each
    seeds: Mapping[str, int]  # by agent, how many it has, or is to get next
    after: int  # how many looks that are none of these there had been

    @property
    def level(self) -> float:
        """The error rate of all of its looks together."""
        return level_of_look(ALPHA, self.after + 1)

    @property
    def share(self) -> float:
        """The error rate of each."""
        return level_of_look(self.level, 1, len(self.sizes))


@dataclass(frozen=True)
class Looks:
    """All looks at the runs on an environment."""

    taken: tuple[Look, ...] = ()  # the looks, in the order of time
    design: Design | None = None  # those that were settled beforehand; None where none were

    @property
    def planned(self) -> tuple[Look, ...]:
        """The looks of the design that have been taken."""
        return tuple(look for look in self.taken if look.planned)

    @property
    def next_level(self) -> float:
        """The error rate of the next look that nobody has settled."""
        return self._unplanned_level(self.taken)

    def level_at(self, place: int) -> float:
        """The error rate that the look at a place in ``taken`` may spend."""
        if not self.taken[place].planned:
            return self._unplanned_level(self.taken[:place])
        if self.design is None:
            raise ValueError("no looks were settled")
        return self.design.share

    def _unplanned_level(self, before: Sequence[Look]) -> float:
        """That of a look after others: the design counts as one, whenever its looks are taken."""
        n_before = sum(not look.planned for look in before)
        with_design = self.design is not None and self.design.after <= n_before
        return level_of_look(ALPHA, n_before + with_design + 1)


LookLog = Mapping[str, Looks]  # all looks at a study, by environment


@dataclass(frozen=True)
class Standing:
    """Where a look stands among all at the runs on an environment."""

    number: int = 1  # which look it is, counted from 1
    level: float = level_of_look(ALPHA, 1)  # its error rate
    next_level: float = level_of_look(ALPHA, 2)  # that of the next
    # The looks that it is one of, which were settled beforehand; None for one by itself.
    design: Design | None = None
    is_counted: bool = True  # False where there are too few runs to claim anything


def question_of(study: StudySpec) -> Question:
    """What a study asks of its runs."""
    return Question(
        study.metric, study.margin, study.threshold, study.first_seed, study.shared_randomness
    )


# --- The file in the folder of a study that remembers the looks at it.

LOOKS_FILE = "looks.json"
_FORMAT, _ABOUT_TYPICAL_RUNS = 2, 1
_LARGEST = 50_000_000  # bytes; a thousand agents looked at a hundred times take less
_LARGEST_NUMBER = 1e300


def write_looks(root: Path, log: LookLog) -> None:
    """Replace the file, so that it is there whole and for good."""
    looks = {name: asdict(each) for name, each in log.items()}
    write_json(root / LOOKS_FILE, {"format": _FORMAT, "environments": looks})


def read_looks(root: Path) -> LookLog:
    """The looks that a study remembers; none where there is no file.

    Raises:
        UserError: if the file is not as it was written, so that nobody knows how many there were.
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
    """Data are not what a dataclass was written as; the text says where."""


def _read_as(kind: Any, data: Any, where: str) -> Any:
    """Plain data as a dataclass that has these fields and no others, each of its type.

    Whole numbers are at least 0, and all numbers finite. `_MisfitError` names what is not so.
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
    """The looks on an environment: one that was taken out between others, or put in, shows."""

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
