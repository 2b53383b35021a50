"""Semi-gradient Q-learning."""

from __future__ import annotations

from typing import Any

from agents.common.exploration import highest_value
from agents.linear.semi_gradient import SemiGradientAlgorithm
from agents.linear.weighted_tiles import LinearAgent
from machine_code.compiling import called


@called
def best_next_value(agent: LinearAgent, env: Any, progress: Any) -> float:
    """The best next action's value."""
    return highest_value(agent.room.sums)


class SemiGradientQ(SemiGradientAlgorithm):
    """Semi-gradient Q-learning (Sutton and Barto, chapter 11).

    Off-policy, bootstrapping, and a function of features: the three together may diverge, as
    Baird's counterexample does (section 11.2).
    """

    next_value = best_next_value
