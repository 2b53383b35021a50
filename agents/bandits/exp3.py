"""Exponential weights against an adversary."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits import reward_checks
from agents.bandits.preferences import PreferenceBandit, softmax
from agents.bandits.score_agent import ScoreAgent
from agents.bandits.table_bandit import TableArguments
from agents.common.setting_checks import check_above_zero, check_share, settings_of
from agents.compiled.generators import generator_of
from machine_code.compiling import inlined
from mdp.array_types import Floats


@inlined
def exp3_probabilities(agent: ScoreAgent, row: int) -> None:
    """Fill in softmax mixed with uniform, the probability of each arm."""
    softmax(agent.tables, row, agent.arms)
    mixing, n_arms = agent.settings.mixing, len(agent.arms)
    for arm in range(n_arms):
        agent.arms[arm] = (1.0 - mixing) * agent.arms[arm] + mixing / n_arms


@inlined
def drawn_arm(probabilities: Floats, uniform: float) -> int:
    """The arm on which ``uniform``, in [0, 1), falls."""
    for arm in range(len(probabilities) - 1):
        uniform -= probabilities[arm]
        if uniform < 0.0:
            return arm
    return len(probabilities) - 1


@inlined
def draw_by_weight(agent: ScoreAgent, row: int, progress: Any) -> int:
    """An arm by its probability."""
    uniform = generator_of(agent.rng).random()
    exp3_probabilities(agent, row)
    return drawn_arm(agent.arms, uniform)


@inlined
def probability_of(agent: ScoreAgent, row: int, arm: int) -> float:
    """How likely the choice of ``arm`` is."""
    exp3_probabilities(agent, row)
    return float(agent.arms[arm])


@inlined
def raise_weight(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Add the reward to the log-weight, the more the less likely its arm was."""
    share = agent.settings.mixing * pull.reward
    agent.tables.scores[pull.row, pull.arm] += share / (pull.probability * len(agent.arms))


class Exp3(PreferenceBandit):
    """Exponential weights for rewards that an adversary may choose (Auer et al., 2002).

    Rewards lie between 0 and 1.

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        mixing: share of uniformly random pulls, in (0, 1]; the paper's gamma.
        kwargs: as in `TableBandit`.
    """

    parameters = {"mixing": np.float64}  # noqa: RUF012
    choose_arm = draw_by_weight
    choice_probability = probability_of
    learn_from_pull = raise_weight

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        mixing: float = 0.1,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.mixing = mixing
        super().__init__(policy, env, **kwargs)

    @property
    def rewards_known(self) -> str:
        """Those of the paper."""
        return reward_checks.UNIT

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_share(settings_of(self, "mixing"))
        check_above_zero(settings_of(self, "mixing"))
