"""What agents share whose scores are preferences or log-weights, and no estimates of rewards."""

from __future__ import annotations

import math

from agents.bandits.score_agent import ScoreTables
from agents.bandits.score_policy import mean_rewards
from agents.bandits.table_bandit import TableBandit
from agents.common.exploration import highest_value
from machine_code.compiling import inlined
from mdp.array_types import Floats


@inlined
def softmax(tables: ScoreTables, row: int, probabilities: Floats) -> None:
    """Fill in the probability of each arm, proportional to exp(score)."""
    for arm in range(len(probabilities)):
        probabilities[arm] = tables.scores[row, arm]
    highest = highest_value(probabilities)
    total = 0.0
    for arm in range(len(probabilities)):
        probabilities[arm] = math.exp(probabilities[arm] - highest)
        total += probabilities[arm]
    for arm in range(len(probabilities)):
        probabilities[arm] /= total


class PreferenceBandit(TableBandit):
    """An agent whose scores are no estimates of rewards."""

    def estimates(self, tables: ScoreTables) -> Floats:
        """Average rewards, nan where there is none, shapes (..., contexts, arms)."""
        return mean_rewards(tables.sums, tables.counts)
