"""The table of agents, by their names."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import re
from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from agents.algorithm_entries import AlgorithmEntry
from agents.known_algorithms import ALGORITHMS

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


def register(name: str, entry_point: str, **fields: Any) -> None:
    """Add an agent of your own to the table, under which the commands find it.

    Nothing is imported: call it where your module is imported, before its heavy imports if it has
    any. Doing so twice changes nothing.

    Args:
        name: what ``--algo`` is to say.
        entry_point: where the class lives, a subclass of `BaseAlgorithm`: ``"module:Class"``.
        fields: further attributes of `AlgorithmEntry`, each with its default: ``summary`` (the
            class's name), ``observations`` and ``actions`` (any space), ``observation_shape``,
            ``for_bandits``, ``needs_masks``, ``package``, ``extra`` and ``engines``, which are
            read off the class where they are left out.

    Raises:
        ValueError: if the name is taken, or an argument is none that an entry can have.
    """
    if not re.fullmatch(r"[A-Za-z0-9]\w*([.-]\w+)*", name, re.ASCII):
        raise ValueError(f"the name of an agent holds letters, digits and _, not {name!r}")
    if not re.fullmatch(r"[\w.]+:\w+", str(entry_point)):
        raise ValueError(f"{name}: the class is named as 'module:Class', not {entry_point!r}")
    unknown = set(fields) - {key.name for key in dataclasses.fields(AlgorithmEntry)}
    if unknown:
        raise ValueError(f"{name}: an entry has no {', '.join(sorted(unknown))}")
    for role in ("observations", "actions"):
        fields[role] = _space_names(name, role, fields.get(role, ()))
    fields.setdefault("summary", entry_point.rpartition(":")[2])
    entry = AlgorithmEntry(entry_point, **fields)
    taken = next((known for known in ALGORITHMS if known.lower() == name.lower()), None)
    if taken is not None and (taken, ALGORITHMS[taken]) != (name, entry):
        raise ValueError(
            f"there is an agent {taken} already ({ALGORITHMS[taken].entry_point}): "
            f"register {entry_point} under another name"
        )
    ALGORITHMS[name] = entry


def _space_names(name: str, role: str, given: Any) -> tuple[str, ...]:
    """The names of spaces as an entry holds them."""
    names = tuple(given) if isinstance(given, list | tuple) else (given,)
    for space in names:
        kind = getattr(spaces, space, None) if isinstance(space, str) else None
        if not (isinstance(kind, type) and issubclass(kind, spaces.Space)):
            raise ValueError(f"{name}: {role} are names of Gymnasium's spaces, not {space!r}")
    return names


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import the class of the agent ``name``.

    Raises:
        KeyError: if there is no agent of that name.
        ModuleNotFoundError: if the optional package that it needs is missing.
        ValueError: if there is no such class, or it is no algorithm of Stable-Baselines3's kind.
    """
    from stable_baselines3.common.base_class import BaseAlgorithm

    entry_point = ALGORITHMS[name].entry_point
    module_name, class_name = entry_point.split(":")
    algorithm = getattr(importlib.import_module(module_name), class_name, None)
    if not (isinstance(algorithm, type) and issubclass(algorithm, BaseAlgorithm)):
        fault = "does not exist" if algorithm is None else "is no subclass of BaseAlgorithm"
        raise ValueError(f"{name} is registered as {entry_point}, which {fault}")
    return algorithm


def fitting_algorithms(
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    bandit: bool = False,
    masks: bool = False,
) -> list[str]:
    """Names of the agents that can work with these spaces, in the order of the table.

    Args:
        observation_space: what is observed.
        action_space: what can be done.
        bandit: whether the environment is a bandit.
        masks: whether the environment says which actions are valid.
    """
    return [
        name
        for name, entry in ALGORITHMS.items()
        if bandit >= entry.for_bandits
        and masks >= entry.needs_masks
        and not entry.misfit(observation_space, action_space)
    ]
