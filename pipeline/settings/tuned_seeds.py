"""On which seeds the settings of a file were tuned: what its key ``tuned_on`` says.

It stands beside the entries, not in them: it is no hyperparameter, no part of what a run is, and
tools that look entries up by environment pass it by.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.errors import UserError, shown

KEY = "tuned_on"


def read_tuned_on(entries: Mapping[str, Any], where: str) -> dict[str, tuple[range, ...]] | None:
    """The seeds on which entries were tried while they were chosen, by the entry's name.

    Args:
        entries: a file of hyperparameters. Under ``tuned_on`` it maps names of entries to
            ``{first: 0, count: 10}``, or to a list of such; an entry that is not named there was
            chosen without trying it on any seed.
        where: the file, for error messages.

    Returns:
        None where the file has no such key, and so does not say.

    Raises:
        UserError: if the key holds anything else, or names an entry that is not there.
    """
    if KEY not in entries:
        return None
    said = entries[KEY]
    if not isinstance(said, dict):
        raise UserError(f"{where}: {KEY} must map entries to seeds, not be {shown(said)}")
    missing = next((name for name in said if name not in entries or name == KEY), None)
    if missing is not None:
        raise UserError(f"{where}: {KEY} names {shown(missing)}, which has no entry there")
    return {
        name: tuple(_seeds(item, f"{where}: {KEY}: {name}") for item in _listed(seeds))
        for name, seeds in said.items()
    }


def _listed(seeds: Any) -> list[Any]:
    return seeds if isinstance(seeds, list) else [seeds]


def _seeds(given: Any, where: str) -> range:
    numbers = list(given.values()) if isinstance(given, dict) else []
    is_whole = all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in numbers)
    if not (isinstance(given, dict) and {*given} == {"first", "count"} and is_whole):
        raise UserError(f"{where} must be like {{first: 0, count: 10}}, not {shown(given)}")
    return range(given["first"], given["first"] + given["count"])
