"""The file in a study's folder that remembers the looks at it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from experiments.looks import Design, Look, LookLog, Looks, Question
from experiments.study_spec import METRICS
from pipeline.errors import UserError, one_line
from pipeline.files import write_json
from safe_files.files import UnsafeFileError, read_file

FILE = "looks.json"
_FORMAT = 1
_LARGEST = 50_000_000  # bytes; a thousand agents looked at a hundred times take less
_LARGEST_NUMBER = 1e300


def write_looks(root: Path, log: LookLog) -> None:
    """Replace the file, so that it is there whole and for good."""
    looks = {name: asdict(each) for name, each in log.environments.items()}
    write_json(root / FILE, {"format": _FORMAT, "environments": looks})


def read_looks(root: Path) -> LookLog:
    """The looks that a study remembers; none where there is no file.

    Raises:
        UserError: if the file is not as it was written, so that nobody knows how many there were.
    """
    path = root / FILE
    try:
        data = json.loads(read_file(path, _LARGEST))
    except FileNotFoundError:
        return LookLog()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    except UnsafeFileError as error:
        raise _wrong(path, str(error).removeprefix(f"{path} ")) from error
    except (ValueError, RecursionError) as error:
        raise _wrong(path, "it is no JSON") from error
    try:
        return _log(data)
    except _WrongEntryError as error:
        raise _wrong(path, f"{error} is not as it was written") from error


def _wrong(path: Path, reason: str) -> UserError:
    return UserError(
        f"{path} is damaged: {reason}; put a copy of it back, or remove it: then the looks at this "
        "study are forgotten"
    )


class _WrongEntryError(Exception):
    """An entry is missing, or cannot have been written."""


def _entries(data: Any, kinds: Mapping[str, Callable[[Any], bool]], where: str) -> dict[str, Any]:
    """A mapping that has these entries, of these kinds, and no others."""
    if not isinstance(data, dict) or data.keys() != kinds.keys():
        raise _WrongEntryError(where)
    for key, is_right in kinds.items():
        if not is_right(data[key]):
            raise _WrongEntryError(f"{where}: {key}")
    return data


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_number_or_none(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return value is None or (is_number and -_LARGEST_NUMBER < value < _LARGEST_NUMBER)


def _is_counts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_count, value.values()))


def _is_sizes(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) > 0
        and all(_is_count(size) and size > 0 for size in value)
        and value == sorted(set(value))
    )


def _is(kind: type) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, kind)


_LOOK: dict[str, Callable[[Any], bool]] = {
    "date": _is(str),
    "question": _is(dict),
    "seeds": _is_counts,
    "runs": _is_counts,
    "digests": lambda value: isinstance(value, dict) and all(map(_is(str), value.values())),
    "level": lambda value: value is not None and _is_number_or_none(value),
    "planned": _is(bool),
}
_DESIGN: dict[str, Callable[[Any], bool]] = {
    "question": _is(dict),
    "sizes": _is_sizes,
    "seeds": _is_counts,
    "after": _is_count,
}
_QUESTION: dict[str, Callable[[Any], bool]] = {
    "metric": lambda value: value in METRICS,
    "margin": _is_number_or_none,
    "threshold": _is_number_or_none,
    "first_seed": _is_count,
}
_LOOKS: dict[str, Callable[[Any], bool]] = {
    "taken": _is(list),
    "design": lambda value: value is None or isinstance(value, dict),
}


def _log(data: Any) -> LookLog:
    kinds = {"format": lambda value: value == _FORMAT, "environments": _is(dict)}
    found = _entries(data, kinds, "the whole")["environments"]
    return LookLog({name: _looks(each, name) for name, each in found.items()})


def _looks(data: Any, where: str) -> Looks:
    found = _entries(data, _LOOKS, where)
    design = None if found["design"] is None else _design(found["design"], f"{where}: design")
    taken = tuple(
        _look(each, f"{where}: look {place}") for place, each in enumerate(found["taken"], start=1)
    )
    looks = Looks(taken, design)
    n_planned = len(looks.planned)
    if n_planned > (0 if design is None else len(design.sizes)):
        raise _WrongEntryError(f"{where}: the number of planned looks")
    if any(design is None or look.seeds.keys() != design.seeds.keys() for look in looks.planned):
        raise _WrongEntryError(f"{where}: the agents of planned looks")
    if design is not None and design.after > len(taken) - n_planned:
        raise _WrongEntryError(f"{where}: the number of looks before the design")
    # A look that was taken out between others, or put in, shows in what the others spent.
    for place, look in enumerate(taken):
        if not math.isclose(look.level, looks.level_at(place), rel_tol=1e-9):
            raise _WrongEntryError(f"{where}: the level of look {place + 1}")
    return looks


def _look(data: Any, where: str) -> Look:
    found = _entries(data, _LOOK, where)
    if not found["seeds"].keys() == found["runs"].keys() == found["digests"].keys():
        raise _WrongEntryError(f"{where}: the agents")
    return Look(**{**found, "question": _question(found["question"], where)})


def _design(data: Any, where: str) -> Design:
    found = _entries(data, _DESIGN, where)
    if not set(found["seeds"].values()) <= set(found["sizes"]):
        raise _WrongEntryError(f"{where}: seeds")
    question = _question(found["question"], where)
    return Design(question, tuple(found["sizes"]), found["seeds"], found["after"])


def _question(data: Any, where: str) -> Question:
    found = _entries(data, _QUESTION, f"{where}: question")
    return Question(**{key.name: found[key.name] for key in fields(Question)})
