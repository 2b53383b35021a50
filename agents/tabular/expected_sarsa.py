"""Expected SARSA."""

from __future__ import annotations

from typing import Any

from agents.common.exploration import expected_value
from agents.tabular.tabular_algorithm import TabularAlgorithm
from agents.tabular.temporal_difference import TabularAgent, exploration_rate
from machine_code.compiling import inlined


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
        if self.exploration == "gaussian_noise":
            raise ValueError(
                "expected_sarsa needs the probabilities of its actions, which gaussian_noise does "
                "not give: take epsilon_greedy or boltzmann"
            )
