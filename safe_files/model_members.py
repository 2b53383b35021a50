"""The parts of a model's zip and its settings as text, looked at before a library is imported."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from safe_files.archives import opened_zip, read_members
from safe_files.limits import MAX_INTEGER_BITS, Budget
from safe_files.refusals import UnsafeFileError, shown

SETTINGS = "data"
TENSORS = frozenset(
    f"{name}.pth"
    for name in (
        "policy",
        "policy.optimizer",
        "actor.optimizer",
        "critic.optimizer",
        "ent_coef_optimizer",
        "pytorch_variables",
        "tensors",
    )
)
MEMBERS = TENSORS | {SETTINGS, "_stable_baselines3_version", "system_info.txt"}

# Algorithms of the user's may keep further files of tensors.
_TENSORS = re.compile(r"\w[\w.]*\.pth", re.ASCII)


def first_look(content: bytes) -> dict[str, Any]:
    """Hold a zip against all that can be said of it without the libraries.

    Args:
        content: the zip.

    Returns:
        Its settings, in which what is pickled stays text.

    Raises:
        UnsafeFileError: if it is no zip of a model, whosever the algorithm is.
    """
    budget = Budget(len(content))
    members = read_members(content, budget=budget)
    strange = sorted(name for name in members if not _may_stand(name))
    if strange:
        raise UnsafeFileError(f"holds {shown(strange[0])}, which no model file has")
    tensors = [name for name in members if name.endswith(".pth")]
    if SETTINGS not in members or not tensors:
        raise UnsafeFileError("lacks parts that a model has")
    for name in tensors:
        with opened_zip(members[name], budget):
            pass
    return parse_settings(members, budget)


def _may_stand(name: str) -> bool:
    return name in MEMBERS or _TENSORS.fullmatch(name) is not None


def parse_settings(members: Mapping[str, bytes], budget: Budget) -> dict[str, Any]:
    """The settings of a model as JSON.

    Args:
        members: of the zip.
        budget: pays for the settings.

    Raises:
        UnsafeFileError: if there are none, or they are no JSON, or too large.
    """
    if SETTINGS not in members:
        raise UnsafeFileError("is no whole zip of a model: it lacks its settings")
    text = members[SETTINGS]
    budget.charge_json(text)
    try:
        data = json.loads(text.decode(), parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise UnsafeFileError(f"has settings that are no JSON: {error}") from error
    if not isinstance(data, dict):
        raise UnsafeFileError("has settings that do not map names to values")
    return data


def _integer(digits: str) -> int:
    if len(digits) > MAX_INTEGER_BITS:
        raise UnsafeFileError("holds an absurdly large number")
    return int(digits)
