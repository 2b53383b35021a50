"""Finite Markov decision processes: the transition model, planning, exact evaluation.

The package works on arrays and imports neither environments nor agents. Functions are imported on
first use: the libraries behind them would delay commands that do not need them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from machine_code.sources import keep_machine_code
from mdp.transition_model import TransitionModel

if TYPE_CHECKING:
    from mdp.evaluation import (
        PolicyReturn,
        baseline_policies,
        baseline_return,
        optimal_choices,
        policy_return,
        state_values,
        state_visitation,
    )
    from mdp.finite_horizon import FiniteHorizonPlan, finite_horizon_optimum
    from mdp.hardness import Hardness, hardness_of
    from mdp.large_maps import optimum_far_from_limit
    from mdp.planning import Plan, policy_iteration, value_iteration

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
    "FiniteHorizonPlan": "mdp.finite_horizon",
    "finite_horizon_optimum": "mdp.finite_horizon",
    "Hardness": "mdp.hardness",
    "hardness_of": "mdp.hardness",
    "Plan": "mdp.planning",
    "policy_iteration": "mdp.planning",
    "value_iteration": "mdp.planning",
    "PolicyReturn": "mdp.evaluation",
    "baseline_return": "mdp.evaluation",
    "baseline_policies": "mdp.evaluation",
    "policy_return": "mdp.evaluation",
    "state_visitation": "mdp.evaluation",
    "optimal_choices": "mdp.evaluation",
    "optimum_far_from_limit": "mdp.large_maps",
    "state_values": "mdp.evaluation",
}

keep_machine_code("mdp")


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'mdp' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
