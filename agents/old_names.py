"""Modules that have moved, under the names by which files that were saved before ask for them.

Zips of Stable-Baselines3 and hyperparameter files name classes by the module that they live in. A
class that moves leaves its old module's name here.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# An old name, and the modules among which what it held is spread today.
MOVED: dict[str, tuple[str, ...]] = {
    "agents.blocks": ("agents.common.callback_horizons",),
    "agents.exploration": ("agents.common.exploration",),
    "agents.model_files": ("agents.common.model_files",),
    "agents.online": ("agents.common.online",),
    "agents.schedules": ("agents.common.schedules",),
    "agents.serialization": ("agents.common.serialization",),
    "agents.step_sizes": ("agents.common.step_sizes",),
    "agents.bandits.base": ("agents.bandits.bandit_algorithm",),
    "agents.bandits.bounds": ("agents.bandits.ucb", "agents.bandits.kl_ucb"),
    "agents.bandits.linear": ("agents.bandits.linear_bandits",),
    "agents.bandits.mabwiser_agents": ("agents.mabwiser.mabwiser_agents",),
    "agents.bandits.mabwiser_policy": ("agents.mabwiser.mabwiser_policy",),
    "agents.bandits.policy": ("agents.bandits.score_policy", "agents.bandits.linear_policy"),
    "agents.bandits.records": ("agents.bandits.pull_log",),
    "agents.bandits.values": ("agents.bandits.value_bandits",),
    "agents.tabular.algorithms": (
        "agents.tabular.q_learning",
        "agents.tabular.sarsa",
        "agents.tabular.expected_sarsa",
        "agents.tabular.double_q_learning",
    ),
    "agents.tabular.base": ("agents.tabular.tabular_algorithm",),
    "agents.tabular.policy": ("agents.tabular.q_table_policy",),
}


class OldNames(MetaPathFinder, Loader):
    """Imports a module of `MOVED` as one that looks its names up where they live now."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        homes = MOVED[module.__name__]

        def find(name: str) -> object:
            for home in homes:
                found = importlib.import_module(home)
                if hasattr(found, name):
                    return getattr(found, name)
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")

        vars(module)["__getattr__"] = find


def install() -> None:
    """Let old names be imported from now on."""
    if not any(isinstance(finder, OldNames) for finder in sys.meta_path):
        sys.meta_path.append(OldNames())
