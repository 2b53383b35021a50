"""Upper confidence bounds by the divergence of coins."""

from __future__ import annotations

import math
from typing import Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits import reward_checks
from agents.bandits.score_agent import ScoreAgent
from agents.bandits.table_bandit import TableArguments
from agents.bandits.upper_bounds import UpperBoundBandit
from agents.common.setting_checks import check_at_least, settings_of
from machine_code.compiling import inlined

MAX_NEWTON_STEPS = 60
PRECISION = 1e-13
LAST_BELOW_ONE = 1.0 - 2.0**-53


@inlined
def bernoulli_kl(p: float, q: float) -> float:
    """Kullback-Leibler divergence from a coin of probability ``p`` to one of ``q`` in (0, 1)."""
    divergence = 0.0
    if p > 0.0:
        divergence += p * math.log(p / q)
    if p < 1.0:
        divergence += (1.0 - p) * math.log((1.0 - p) / (1.0 - q))
    return divergence


@inlined
def kl_upper_bound(p: float, budget: float) -> float:
    """The highest q with kl(p, q) <= ``budget``, for ``p`` in [0, 1].

    Newton's method from above: the divergence is convex in q, so that the steps never cross the
    solution, and Pinsker's inequality gives where to start.
    """
    if budget <= 0.0 or p >= 1.0:
        return p
    q = min(p + math.sqrt(0.5 * budget), LAST_BELOW_ONE)
    for _ in range(MAX_NEWTON_STEPS):
        excess = bernoulli_kl(p, q) - budget
        step = excess * q * (1.0 - q) / (q - p)
        if step <= PRECISION * min(q, 1.0 - q):
            break
        q -= step
    return q


@inlined
def kl_ucb_index(mean: float, count: int, pulls: int, c: float) -> float:
    """The highest q with count * kl(mean, q) <= ln(pulls) + c ln(ln(pulls)).

    Source: Garivier and Cappe, 2011.
    """
    log_pulls = math.log(pulls)
    return kl_upper_bound(mean, (log_pulls + c * math.log(max(log_pulls, 1.0))) / count)


@inlined
def kl_ucb_bound(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """`kl_ucb_index` with the agent's settings."""
    return kl_ucb_index(mean, count, pulls, agent.settings.c)


class KLUCB(UpperBoundBandit):
    """Upper confidence bounds by the divergence of coins (Garivier and Cappe, 2011).

    Each arm is pulled once before any bound counts. Rewards lie between 0 and 1.

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        c: of the bound's ln t + c ln ln t; the authors prove with 3 and recommend 0.
        kwargs: as in `TableBandit`.
    """

    parameters = {"c": np.float64}  # noqa: RUF012
    upper_bound = kl_ucb_bound

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
        return reward_checks.UNIT

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0, settings_of(self, "c"))
