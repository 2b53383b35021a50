"""Agents that draw arms by preferences: the gradient bandit and Exp3."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule

from rl_yardstick.agents.bandits.algorithm import UNIT
from rl_yardstick.agents.bandits.choosing import ScoreAgent, ScoreTables, mean_reward, total_count
from rl_yardstick.agents.bandits.tables import TableBandit, mean_rewards
from rl_yardstick.agents.common.exploration import (
    BOLTZMANN,
    action_probabilities,
    boltzmann_action,
    drawn_action,
    make_probabilities,
)
from rl_yardstick.agents.common.settings import POSITIVE_SHARE
from rl_yardstick.agents.compiled.generators import generator_of
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats

# The base of agents whose scores are preferences or log-weights instead of estimates of rewards.


@inlined
def softmax(tables: ScoreTables, row: int, probabilities: Floats) -> None:
    """Fill in the probability of each arm, proportional to exp(score)."""
    for arm in range(len(probabilities)):
        probabilities[arm] = tables.scores[row, arm]
    make_probabilities(probabilities)


class PreferenceBandit(TableBandit):
    """An agent whose scores are not estimates of rewards."""

    def estimates(self, tables: ScoreTables) -> Floats:
        """Average rewards, nan where there is none, shapes (..., contexts, arms)."""
        return mean_rewards(tables.sums, tables.counts)

    def action_probabilities(self, observations: NDArray[Any]) -> Floats:
        """The probabilities of arms now at each of n observations, shape (n, arms)."""
        scores = self.policy.judged(observations)
        return action_probabilities(BOLTZMANN, scores, 1.0, random_ties=False)


# The gradient bandit.


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

    The baseline is the average of the rewards before this one; for the first it is that reward.
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
        args: as in `TableBandit`.
        learning_rate: step size, constant or scheduled.
        baseline: compare a reward with the average of those before it, as in the book's second
            edition (its drafts included the reward itself); else with 0.
        kwargs: as in `TableBandit`.
    """

    parameters = {"baseline": np.bool_}  # noqa: RUF012
    choose_arm = choose_by_preference
    before_counting = gradient_step
    learn_from_pull = nothing_after

    def __init__(
        self,
        *args: Any,
        learning_rate: float | Schedule = 0.1,
        baseline: bool = True,
        **kwargs: Any,
    ) -> None:
        self.baseline = baseline
        super().__init__(*args, learning_rate=learning_rate, **kwargs)


# Exponential weights against an adversary.


@inlined
def exp3_probabilities(agent: ScoreAgent, row: int) -> None:
    """Fill in softmax mixed with uniform, the probability of each arm."""
    softmax(agent.tables, row, agent.arms)
    mixing, n_arms = agent.settings.mixing, len(agent.arms)
    for arm in range(n_arms):
        agent.arms[arm] = (1.0 - mixing) * agent.arms[arm] + mixing / n_arms


@inlined
def draw_by_weight(agent: ScoreAgent, row: int, progress: Any) -> int:
    """Draw an arm by the probabilities."""
    uniform = generator_of(agent.rng).random()
    exp3_probabilities(agent, row)
    return drawn_action(agent.arms, uniform)


@inlined
def probability_of(agent: ScoreAgent, row: int, arm: int) -> float:
    """The probability of choosing ``arm``."""
    exp3_probabilities(agent, row)
    return float(agent.arms[arm])


@inlined
def raise_weight(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Add the importance-weighted reward (reward / probability) to the arm's log-weight."""
    share = agent.settings.mixing * pull.reward
    agent.tables.scores[pull.row, pull.arm] += share / (pull.probability * len(agent.arms))


class Exp3(PreferenceBandit):
    """Exponential weights for rewards that an adversary may choose (Auer et al., 2002).

    Rewards lie between 0 and 1.

    Args:
        args: as in `TableBandit`.
        mixing: share of uniformly random pulls, in (0, 1]; the paper's gamma.
        kwargs: as in `TableBandit`.
    """

    parameters = {"mixing": np.float64}  # noqa: RUF012
    ranges = {"mixing": POSITIVE_SHARE}  # noqa: RUF012
    rewards_known = UNIT
    choose_arm = draw_by_weight
    choice_probability = probability_of
    learn_from_pull = raise_weight

    hidden_arguments = ("learning_rate",)

    def __init__(self, *args: Any, mixing: float = 0.1, **kwargs: Any) -> None:
        self.mixing = mixing
        super().__init__(*args, **kwargs)

    def action_probabilities(self, observations: NDArray[Any]) -> Floats:
        """As above, mixed with uniform."""
        softmax = super().action_probabilities(observations)
        return (1.0 - self.mixing) * softmax + self.mixing / self.n_arms
