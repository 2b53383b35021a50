"""Q-learning, SARSA, Expected SARSA and double Q-learning: methods that learn from one step."""

from __future__ import annotations

from typing import Any

from rl_yardstick.agents.common.exploration import expected_value, greedy_action, highest_value
from rl_yardstick.agents.tabular.algorithm import TabularAlgorithm
from rl_yardstick.agents.tabular.updates import TabularAgent, choose, exploration_rate
from rl_yardstick.machine_code.compiling import inlined


@inlined
def best_next_value(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The best next action's value."""
    return highest_value(agent.room.values)


class QLearning(TabularAlgorithm):
    """Q-learning (Watkins, 1989; Sutton and Barto, section 6.5)."""

    next_value = best_next_value


@inlined
def commit_to_next_action(agent: TabularAgent, env: Any, progress: Any) -> None:
    """Choose the next action, unless the episode has terminated."""
    env.next_action = 0
    if not env.terminated:
        env.next_action = choose(agent, env.next_obs, progress)


@inlined
def committed_value(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The value of the next action that the agent has committed to."""
    return float(agent.tables.values[table, env.next_obs, env.next_action])


class SARSA(TabularAlgorithm):
    """SARSA (Rummery and Niranjan, 1994; Sutton and Barto, section 6.4).

    It commits to its next action before the update that uses it. If an episode is truncated, it
    chooses an action in the last state for the target only.
    """

    commit = commit_to_next_action
    next_value = committed_value


@inlined
def mean_next_value(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The mean value under the exploring policy."""
    rate = exploration_rate(agent, progress)
    return expected_value(agent.settings.strategy, agent.room.values, rate)


class ExpectedSARSA(TabularAlgorithm):
    """Expected SARSA (van Seijen et al., 2009; Sutton and Barto, section 6.6)."""

    next_value = mean_next_value

    def _check_arguments(self) -> None:
        super()._check_arguments()
        self._refuse_gaussian_noise("expected_sarsa")


@inlined
def value_by_the_other_table(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The other table's value of the action that the updated table prefers.

    The remainder of the random number that chose the table breaks ties.
    """
    values = agent.tables.values
    uniform = (env.uniform * values.shape[0] - table) * agent.settings.tie_scale
    best = greedy_action(agent.room.values, uniform)
    return float(values[1 - table, env.next_obs, agent.room.actions[best]])


class DoubleQLearning(TabularAlgorithm):
    """Double Q-learning (van Hasselt, 2010; Sutton and Barto, section 6.7)."""

    next_value = value_by_the_other_table
    n_tables = 2
