"""Upper confidence bounds."""

from __future__ import annotations

import math
from typing import Literal, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits.score_agent import ScoreAgent
from agents.bandits.table_bandit import TableArguments
from agents.bandits.upper_bounds import UpperBoundBandit
from agents.common.setting_checks import check_at_least, check_option, settings_of
from machine_code.compiling import inlined

Variant = Literal["ucb1", "sutton_barto"]


@inlined
def ucb_index(mean: float, count: int, pulls: int, width: float, textbook: bool) -> float:
    """Mean plus width sqrt(2 ln t / n) after t pulls, or width sqrt(ln t / n) at the t-th pull.

    The first is UCB1 (Auer et al., 2002), the second Sutton and Barto's, section 2.7.
    """
    factor, offset = (1.0, 1.0) if textbook else (2.0, 0.0)
    return mean + width * math.sqrt(factor * math.log(pulls + offset) / count)


@inlined
def ucb_bound(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """`ucb_index` with the agent's settings."""
    return ucb_index(mean, count, pulls, agent.settings.width, agent.settings.is_textbook)


class UCB(UpperBoundBandit):
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

    parameters = {"width": np.float64, "is_textbook": np.bool_}  # noqa: RUF012
    upper_bound = ucb_bound

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
    def is_textbook(self) -> bool:
        """Whether the bound is Sutton and Barto's."""
        return self.variant == "sutton_barto"

    @property
    def width(self) -> float:
        """How much to explore."""
        default = 2.0 if self.is_textbook else 1.0
        return default if self.c is None else self.c

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_option("variant", self.variant, Variant)
        check_at_least(0, settings_of(self, "c"))
