"""Agents that draw arms by preferences, which are no estimates of rewards: gradient ascent."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.bandits.preferences import PreferenceBandit, softmax
from agents.bandits.score_agent import ScoreAgent, mean_reward, total_count
from agents.bandits.table_bandit import TableArguments
from agents.common.exploration import boltzmann_action
from agents.compiled.generators import generator_of
from machine_code.compiling import inlined


@inlined
def choose_by_preference(agent: ScoreAgent, row: int, progress: Any) -> int:
    """An arm with probability proportional to exp(preference)."""
    agent.draws[0] = generator_of(agent.rng).random()
    for arm in range(len(agent.arms)):
        agent.arms[arm] = agent.tables.scores[row, arm]
    return boltzmann_action(agent.arms, 1.0, agent.draws)


@inlined
def gradient_step(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Move the preferences (Sutton and Barto, section 2.8).

    The baseline is the average of the rewards before this one, and this one at the very first.
    """
    tables = agent.tables
    baseline = 0.0
    if agent.settings.baseline:
        first = total_count(tables, pull.row) == 0
        baseline = pull.reward if first else mean_reward(tables, pull.row)
    softmax(tables, pull.row, agent.arms)
    for arm in range(len(agent.arms)):
        chosen = 1.0 if arm == pull.arm else 0.0
        advantage = progress.learning_rate * (pull.reward - baseline)
        tables.scores[pull.row, arm] += advantage * (chosen - agent.arms[arm])


@inlined
def nothing_after(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """The preferences have moved already."""


class GradientBandit(PreferenceBandit):
    """Gradient ascent on preferences (Sutton and Barto, section 2.8).

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        learning_rate: step size, constant or scheduled.
        baseline: compare a reward with the average of those before it, as the book's second edition
            has it (its drafts included the reward itself); else with 0.
        kwargs: as in `TableBandit`.
    """

    parameters = {"baseline": np.bool_}  # noqa: RUF012
    choose_arm = choose_by_preference
    before_counting = gradient_step
    learn_from_pull = nothing_after

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        baseline: bool = True,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.baseline = baseline
        super().__init__(policy, env, learning_rate, **kwargs)
