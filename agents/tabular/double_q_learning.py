"""Double Q-learning."""

from __future__ import annotations

from typing import Any

from agents.common.exploration import greedy_action
from agents.tabular.tabular_algorithm import TabularAlgorithm
from agents.tabular.temporal_difference import TabularAgent
from machine_code.compiling import inlined


@inlined
def value_by_the_other_table(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The other table's value of the action that the updated table prefers.

    What is left of the number that chose the table breaks ties.
    """
    values = agent.tables.values
    uniform = (env.uniform * values.shape[0] - table) * agent.settings.tie_scale
    best = greedy_action(agent.room.values, uniform)
    return float(values[1 - table, env.next_obs, agent.room.actions[best]])


class DoubleQLearning(TabularAlgorithm):
    """Double Q-learning (van Hasselt, 2010; Sutton and Barto, section 6.7)."""

    next_value = value_by_the_other_table
    n_tables = 2
