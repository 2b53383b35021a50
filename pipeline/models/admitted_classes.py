"""What zips of agents may hold beside what the libraries put there: classes of ours and the user's.

The user's are those of the modules that were typed on the command line, and of the module that the
agent itself comes from. They are looked up among what is imported already.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from pipeline.user_modules import UserModule

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


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
