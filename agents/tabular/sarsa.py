"""SARSA."""

from __future__ import annotations

from typing import Any

from agents.tabular.tabular_algorithm import TabularAlgorithm
from agents.tabular.temporal_difference import TabularAgent, choose
from machine_code.compiling import inlined


@inlined
def commit_to_next_action(agent: TabularAgent, env: Any, progress: Any) -> None:
    """Choose what to do next; nothing where nothing follows."""
    env.next_action = 0
    if not env.terminated:
        env.next_action = choose(agent, env.next_obs, progress)


@inlined
def committed_value(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The value of the next action that the agent has committed to."""
    return float(agent.tables.values[table, env.next_obs, env.next_action])


class SARSA(TabularAlgorithm):
    """SARSA (Rummery and Niranjan, 1994; Sutton and Barto, section 6.4).

    It commits to its next action before the update that uses it. Where an episode is truncated, it
    chooses an action in the last state for the target alone.
    """

    commit = commit_to_next_action
    next_value = committed_value
