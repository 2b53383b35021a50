"""Finite Markov decision processes: the transition model, planning, exact evaluation.

The package knows arrays alone, neither environments nor agents. The functions are loaded on first
use, because the libraries behind them take longer to import than a command may take to answer.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from mdp.transition_model import TransitionModel

if TYPE_CHECKING:
    from mdp.far_limit import optimum_far_from_limit
    from mdp.finite_horizon import FiniteHorizonPlan, finite_horizon_optimum
    from mdp.optimal_policies import Plan, policy_iteration, value_iteration
    from mdp.policy_evaluation import (
        baseline_policies,
        baseline_return,
        policy_return,
        state_visitation,
    )
    from mdp.policy_returns import PolicyReturn
    from mdp.valuation import optimal_choices, state_values

__all__ = [
    "FiniteHorizonPlan",
    "Plan",
    "PolicyReturn",
    "TransitionModel",
    "baseline_policies",
    "baseline_return",
    "finite_horizon_optimum",
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
    "Plan": "mdp.optimal_policies",
    "policy_iteration": "mdp.optimal_policies",
    "value_iteration": "mdp.optimal_policies",
    "PolicyReturn": "mdp.policy_returns",
    "baseline_return": "mdp.policy_evaluation",
    "baseline_policies": "mdp.policy_evaluation",
    "policy_return": "mdp.policy_evaluation",
    "state_visitation": "mdp.policy_evaluation",
    "optimal_choices": "mdp.valuation",
    "optimum_far_from_limit": "mdp.far_limit",
    "state_values": "mdp.valuation",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'mdp' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
