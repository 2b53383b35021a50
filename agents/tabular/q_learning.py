"""Q-learning."""

from __future__ import annotations

from typing import Any

from agents.common.exploration import highest_value
from agents.tabular.tabular_algorithm import TabularAlgorithm
from agents.tabular.temporal_difference import TabularAgent
from machine_code.compiling import inlined


@inlined
def best_next_value(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The best next action's value."""
    return highest_value(agent.room.values)


class QLearning(TabularAlgorithm):
    """Q-learning (Watkins, 1989; Sutton and Barto, section 6.5)."""

    next_value = best_next_value
