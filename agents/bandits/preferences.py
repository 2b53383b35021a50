"""Agents that draw arms by preferences, which are no estimates of rewards."""

from __future__ import annotations

from typing import Unpack

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.bandits import rewards
from agents.bandits.arguments import TableArguments, check_above_zero, check_share
from agents.bandits.policy import mean_rewards
from agents.bandits.table_bandit import TableBandit
from agents.bandits.tables import EXP3, GRADIENT, Tables


class PreferenceBandit(TableBandit):
    """An agent whose scores are no estimates of rewards."""

    def estimates(self, tables: Tables) -> NDArray[np.float64]:
        """Average rewards, nan where there is none, shapes (..., contexts, arms)."""
        return mean_rewards(tables.sums, tables.counts)


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

    rule = GRADIENT

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        baseline: bool = True,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.baseline = baseline
        self._step_size = learning_rate
        super().__init__(policy, env, **kwargs)

    def _parameters(self) -> tuple[float, float, float]:
        return float(self.baseline), 0.0, 0.0


class Exp3(PreferenceBandit):
    """Exponential weights for rewards that an adversary may choose (Auer et al., 2002).

    Rewards lie between 0 and 1.

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        mixing: share of uniformly random pulls, in (0, 1]; the paper's gamma.
        kwargs: as in `TableBandit`.
    """

    rule = EXP3

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
        return rewards.UNIT

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_share([("mixing", self.mixing)])
        check_above_zero([("mixing", self.mixing)])

    def _parameters(self) -> tuple[float, float, float]:
        return self.mixing, 0.0, 0.0
