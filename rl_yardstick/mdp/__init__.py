"""Finite Markov decision processes: the transition model, planning, exact evaluation.

The package works on arrays and imports neither environments nor agents. Functions are imported on
first use: the libraries behind them would delay commands that do not need them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from rl_yardstick.machine_code.sources import keep_machine_code
from rl_yardstick.mdp.transition_model import TransitionModel

if TYPE_CHECKING:
    from rl_yardstick.mdp.evaluation import (
        PolicyReturn,
        baseline_policies,
        baseline_return,
        optimal_choices,
        policy_return,
        state_values,
        state_visitation,
    )
    from rl_yardstick.mdp.finite_horizon import FiniteHorizonPlan, finite_horizon_optimum
    from rl_yardstick.mdp.hardness import Hardness, hardness_of
    from rl_yardstick.mdp.large_maps import optimum_far_from_limit
    from rl_yardstick.mdp.planning import Plan, policy_iteration, value_iteration

__all__ = [
    "FiniteHorizonPlan",
    "Hardness",
    "Plan",
    "PolicyReturn",
    "TransitionModel",
    "baseline_policies",
    "baseline_return",
    "finite_horizon_optimum",
    "hardness_of",
    "optimal_choices",
    "optimum_far_from_limit",
    "policy_iteration",
    "policy_return",
    "state_values",
    "state_visitation",
    "value_iteration",
]

_HOMES = {
    "FiniteHorizonPlan": "rl_yardstick.mdp.finite_horizon",
    "finite_horizon_optimum": "rl_yardstick.mdp.finite_horizon",
    "Hardness": "rl_yardstick.mdp.hardness",
    "hardness_of": "rl_yardstick.mdp.hardness",
    "Plan": "rl_yardstick.mdp.planning",
    "policy_iteration": "rl_yardstick.mdp.planning",
    "value_iteration": "rl_yardstick.mdp.planning",
    "PolicyReturn": "rl_yardstick.mdp.evaluation",
    "baseline_return": "rl_yardstick.mdp.evaluation",
    "baseline_policies": "rl_yardstick.mdp.evaluation",
    "policy_return": "rl_yardstick.mdp.evaluation",
    "state_visitation": "rl_yardstick.mdp.evaluation",
    "optimal_choices": "rl_yardstick.mdp.evaluation",
    "optimum_far_from_limit": "rl_yardstick.mdp.large_maps",
    "state_values": "rl_yardstick.mdp.evaluation",
}

keep_machine_code("mdp")


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'rl_yardstick.mdp' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
