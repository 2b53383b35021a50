"""What agents share that pull the arm of the highest upper confidence bound."""

from __future__ import annotations

import math
from typing import Any

from agents.bandits.score_agent import ScoreAgent, total_count
from agents.bandits.table_bandit import TableBandit
from agents.common.exploration import greedy_action
from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.generators import generator_of
from machine_code.compiling import inlined


@by_type
def upper_bound(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """The bound of an arm after ``count`` of ``pulls`` pulls."""
    raise CompiledOnlyError


@inlined
def highest_bound(agent: ScoreAgent, row: int, progress: Any) -> int:
    """An arm of the highest bound, which is infinite for those not tried."""
    uniform = generator_of(agent.rng).random()
    pulls = total_count(agent.tables, row)
    for arm in range(len(agent.arms)):
        count = agent.tables.counts[row, arm]
        if count == 0:
            agent.arms[arm] = math.inf
        else:
            agent.arms[arm] = upper_bound(agent, agent.tables.scores[row, arm], count, pulls)
    return greedy_action(agent.arms, uniform * agent.settings.tie_scale)


@inlined
def average_rewards(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """The score is the mean reward."""
    tables = agent.tables
    total, count = tables.sums[pull.row, pull.arm], tables.counts[pull.row, pull.arm]
    tables.scores[pull.row, pull.arm] = total / count


class UpperBoundBandit(TableBandit):
    """Pulls each arm once, and then the one of the highest bound; `upper_bound` is its own."""

    choose_arm = highest_bound
    learn_from_pull = average_rewards

    @property
    def initial_score(self) -> float:
        """Below that of any arm that was tried."""
        return -math.inf
