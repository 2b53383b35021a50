"""What a model file holds, and what in it is suspicious, said without making a model of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safe_files.archives import MEMBERS, TENSORS, parse_settings, read_members
from safe_files.limits import MAX_ARCHIVE_BYTES, Budget
from safe_files.models import NOT_READ, SERIALIZED, decoded
from safe_files.objects import all_policy_classes, read_pickle
from safe_files.pickle_trees import Name, parts_of, read_tree
from safe_files.rebuilding import Maker
from safe_files.refusals import UnsafeFileError, shown
from safe_files.regular_files import read_file
from safe_files.tensors import check_values, load_tensors, tensors_in


@dataclass(frozen=True)
class Report:
    """What a file holds.

    Attributes:
        sizes: bytes of each member of the zip.
        weights: shapes of the tensors, by member and name.
        settings: what each attribute is, as a text of one line.
        suspicious: what should make a reader wary, each in one line; empty where nothing does.
    """

    sizes: dict[str, int]
    weights: dict[str, tuple[int, ...]]
    settings: dict[str, str]
    suspicious: tuple[str, ...]


def inspect_model(path: Path | str, makers: Mapping[str, Maker] | None = None) -> Report:
    """Look into a model's zip; nothing in it is run.

    Args:
        path: the zip.
        makers: what makes further objects that it may hold, as for `safe_files.load_model`.

    Raises:
        UnsafeFileError: if it is no zip of a model at all.
        OSError: if it cannot be read.
    """
    content = read_file(Path(path), MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    members = read_members(content, MEMBERS, budget)
    settings: dict[str, str] = {}
    suspicious: list[str] = []
    for key, value in parse_settings(members, budget).items():
        settings[shown(key).strip("'")], doubts = _setting(key, value, makers, budget)
        suspicious += doubts
    weights: dict[str, tuple[int, ...]] = {}
    for name in sorted(TENSORS & set(members)):
        try:
            tensors = load_tensors(members[name], budget)
            check_values({name: tensors})
        except UnsafeFileError as error:
            suspicious.append(f"{name} {error}")
        else:
            found = tensors_in(tensors, name.removesuffix(".pth"))
            weights |= {shown(where).strip("'"): tuple(tensor.shape) for where, tensor in found}
    sizes = {name: len(content) for name, content in members.items()}
    return Report(sizes, weights, settings, tuple(suspicious))


def _setting(
    key: str, value: Any, makers: Mapping[str, Maker] | None, budget: Budget
) -> tuple[str, list[str]]:
    """An attribute in one line, and what is suspicious about it."""
    is_odd = key in NOT_READ - {"tensorboard_log"} and value
    name = shown(key).strip("'")
    doubts = [f"{name} is set, which models do not keep"] if is_odd else []
    if not (isinstance(value, dict) and SERIALIZED in value):
        return shown(value), doubts
    try:
        pickled = decoded(key, value[SERIALIZED])
        names = sorted({shown(str(one)).strip("'") for one in names_in(read_tree(pickled, budget))})
        text = "a pickle of " + (", ".join(names) if names else "plain data")
    except UnsafeFileError as error:
        return "a pickle that cannot be read", [*doubts, f"{name} {error}"]
    try:
        read_pickle(pickled, all_policy_classes(), makers, budget)
    except UnsafeFileError as error:
        doubts.append(f"{name} {error}")
    return text, doubts


def names_in(tree: Any) -> Iterator[Name]:
    """The classes and functions that a tree refers to, each place that it does once."""
    pending, seen = [tree], set()
    while pending:
        part = pending.pop()
        if id(part) in seen:
            continue
        seen.add(id(part))
        if isinstance(part, Name):
            yield part
        pending.extend(parts_of(part))
