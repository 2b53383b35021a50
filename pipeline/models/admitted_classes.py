"""What zips of agents may hold beside what the libraries put there: classes of ours and the user's.

The user's are those of the modules that were typed on the command line, and of the module that the
agent itself comes from. They are looked up among what is imported already.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from pipeline.user_modules import UserModule

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

# Where the schedule lived that zips of library agents once held.
_SCHEDULES = ("agents.schedules", "agents.common.schedules")


def own_classes(
    algorithm: type[BaseAlgorithm], modules: Iterable[UserModule]
) -> Mapping[str, type]:
    """Networks, optimizers and buffers of the user's, by their full names.

    Args:
        algorithm: the agent's class.
        modules: those that the user typed.
    """
    from stable_baselines3.common.buffers import BaseBuffer
    from torch import nn, optim

    # No others: what a file names as a part of a network is called with what it says.
    kinds = (nn.Module, optim.Optimizer, BaseBuffer)
    homes = {module.name for module in modules} | {algorithm.__module__}
    found: dict[str, type] = {}
    for name, module in list(sys.modules.items()):
        if any(f"{name}.".startswith(f"{home}.") for home in homes):
            for value in list(vars(module).values()):
                if isinstance(value, type) and issubclass(value, kinds):
                    found |= {f"{value.__module__}.{value.__qualname__}": value}
    return {name: cls for name, cls in found.items() if _lies_in(cls, homes)}


def _lies_in(cls: type, homes: Iterable[str]) -> bool:
    return any(f"{cls.__module__}.".startswith(f"{home}.") for home in homes)


def own_makers() -> Mapping[str, Any]:
    """What makes objects of ours, by the full names of their classes."""
    from agents.common.schedules import ExponentialSchedule
    from safe_files.pickle_trees import Made
    from safe_files.rebuilding import Build, fields

    def schedule(made: Made, build: Build) -> ExponentialSchedule:
        return ExponentialSchedule(**fields(made, build))

    return {f"{module}.ExponentialSchedule": schedule for module in _SCHEDULES}
