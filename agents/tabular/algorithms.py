"""The four tabular agents. They differ in their target, and SARSA in when it chooses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.common.online import Transitions
from agents.tabular import rules
from agents.tabular.base import TabularAlgorithm
from agents.tabular.steps import UNDECIDED


class QLearning(TabularAlgorithm):
    """Q-learning (Watkins, 1989; Sutton and Barto, section 6.5)."""

    rule = rules.Q_LEARNING


class SARSA(TabularAlgorithm):
    """SARSA (Rummery and Niranjan, 1994; Sutton and Barto, section 6.4).

    It commits to its next action before the update that uses it. Where an episode is truncated, it
    chooses an action in the last state for the target alone.
    """

    rule = rules.SARSA

    def _choose_actions(self) -> NDArray[np.int64]:
        actions = super()._choose_actions()
        assert self._next_actions is not None
        self._next_actions.fill(UNDECIDED)
        return actions

    def _commit_to_next_actions(self, transitions: Transitions) -> NDArray[np.int64]:
        pending = self._next_actions
        assert pending is not None
        pending[transitions.terminated] = 0
        self._decide(transitions.next_obs, pending, self.rng)
        actions = pending.copy()
        pending[transitions.dones] = UNDECIDED
        return actions


class ExpectedSARSA(TabularAlgorithm):
    """Expected SARSA (van Seijen et al., 2009; Sutton and Barto, section 6.6)."""

    rule = rules.EXPECTED_SARSA

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.exploration == "gaussian_noise":
            raise ValueError(
                "expected_sarsa needs the probabilities of its actions, which gaussian_noise does "
                "not give: take epsilon_greedy or boltzmann"
            )


class DoubleQLearning(TabularAlgorithm):
    """Double Q-learning (van Hasselt, 2010; Sutton and Barto, section 6.7)."""

    rule = rules.DOUBLE_Q_LEARNING
    n_tables = 2
