"""Agents that pull the arm of the highest upper confidence bound."""

from __future__ import annotations

import math
from typing import Literal, Unpack

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits import rewards, tables
from agents.bandits.arguments import TableArguments, check_at_least, check_option
from agents.bandits.table_bandit import TableBandit

Variant = Literal["ucb1", "sutton_barto"]


class UCB(TableBandit):
    """Upper confidence bounds: UCB1 (Auer et al., 2002), or as Sutton and Barto, section 2.7.

    Each arm is pulled once before any bound counts.

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        variant: ``"ucb1"``: mean + c sqrt(2 ln t / n) after t pulls; ``"sutton_barto"``: mean +
            c sqrt(ln t / n) at the t-th pull.
        c: how much to explore; by default 1 for UCB1 and 2 for Sutton and Barto's.
        kwargs: as in `TableBandit`.
    """

    rule = tables.UCB

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        variant: Variant = "ucb1",
        c: float | None = None,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.variant = variant
        self.c = c
        super().__init__(policy, env, **kwargs)

    @property
    def initial_score(self) -> float:
        """Below that of any arm that was tried."""
        return -math.inf

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_option("variant", self.variant, Variant)
        check_at_least(0, [("c", self.c)])

    def _parameters(self) -> tuple[float, float, float]:
        if self.variant == "ucb1":
            return 1.0 if self.c is None else self.c, 2.0, 0.0
        return 2.0 if self.c is None else self.c, 1.0, 1.0


class KLUCB(TableBandit):
    """Upper confidence bounds by the divergence of coins (Garivier and Cappe, 2011).

    Each arm is pulled once before any bound counts. Rewards lie between 0 and 1.

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        c: of the bound's ln t + c ln ln t; the authors prove with 3 and recommend 0.
        kwargs: as in `TableBandit`.
    """

    rule = tables.KL_UCB
    initial_score = UCB.initial_score

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        c: float = 0.0,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.c = c
        super().__init__(policy, env, **kwargs)

    @property
    def rewards_known(self) -> str:
        """Those of a coin, or in between."""
        return rewards.UNIT

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0, [("c", self.c)])

    def _parameters(self) -> tuple[float, float, float]:
        return self.c, 0.0, 0.0
