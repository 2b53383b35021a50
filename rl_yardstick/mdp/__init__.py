"""Finite Markov decision processes: the transition model, planning, exact evaluation.

The package works on arrays and imports neither environments nor agents. Functions are imported on
first use: the libraries behind them would delay commands that do not need them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from rl_yardstick.mdp.transition_model import TransitionModel

if TYPE_CHECKING:
    from rl_yardstick.mdp.evaluation import (
        PolicyReturn,
        baseline_policies,
        baseline_return,
        last_visits,
        optimal_choices,
        policy_return,
        state_values,
        state_visitation,
    )
    from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum, optimum_far_from_limit
    from rl_yardstick.mdp.hardness import Hardness, hardness_of
    from rl_yardstick.mdp.planning import Plan, policy_iteration, value_iteration

__all__ = [
    "Hardness",
    "Plan",
    "PolicyReturn",
    "TransitionModel",
    "baseline_policies",
    "baseline_return",
    "finite_horizon_optimum",
    "hardness_of",
    "last_visits",
    "optimal_choices",
    "optimum_far_from_limit",
    "policy_iteration",
    "policy_return",
    "state_values",
    "state_visitation",
    "value_iteration",
]


def __getattr__(name: str) -> object:
    for home in ("planning", "evaluation", "finite_horizon", "hardness") if name in __all__ else ():
        module = importlib.import_module(f"rl_yardstick.mdp.{home}")
        if hasattr(module, name):
            return getattr(module, name)
    raise AttributeError(f"module 'rl_yardstick.mdp' has no attribute {name!r}")
