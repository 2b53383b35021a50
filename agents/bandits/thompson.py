"""Thompson sampling."""

from __future__ import annotations

from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits import rewards
from agents.bandits.arguments import (
    TableArguments,
    check_above_zero,
    check_finite,
    check_option,
)
from agents.bandits.table_bandit import TableBandit
from agents.bandits.tables import BETA_THOMPSON, GAUSSIAN_THOMPSON, Settings, Tables

Likelihood = Literal["bernoulli", "gaussian"]


class Thompson(TableBandit):
    """Thompson sampling: pulls an arm as often as it is likely to be the best (Thompson, 1933).

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        likelihood: ``"bernoulli"``: rewards of 0 and 1 and a Beta prior; ``"gaussian"``: rewards
            with normal noise of a known deviation and a normal prior.
        prior_successes: first parameter of the Beta prior.
        prior_failures: second parameter of the Beta prior.
        prior_mean: of the normal prior.
        prior_std: standard deviation of the normal prior.
        reward_std: standard deviation of the noise.
        kwargs: as in `TableBandit`.
    """

    rule = BETA_THOMPSON

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        likelihood: Likelihood = "bernoulli",
        prior_successes: float = 1.0,
        prior_failures: float = 1.0,
        prior_mean: float = 0.0,
        prior_std: float = 1.0,
        reward_std: float = 1.0,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.likelihood = likelihood
        self.prior_successes = prior_successes
        self.prior_failures = prior_failures
        self.prior_mean = prior_mean
        self.prior_std = prior_std
        self.reward_std = reward_std
        super().__init__(policy, env, **kwargs)

    @property
    def is_gaussian(self) -> bool:
        """Whether rewards are taken to have normal noise."""
        return self.likelihood == "gaussian"

    @property
    def rewards_known(self) -> str:
        """Those of a coin, unless they have normal noise."""
        return rewards.ANY if self.is_gaussian else rewards.BINARY

    @property
    def initial_score(self) -> float:
        """The mean of the prior."""
        if self.is_gaussian:
            return self.prior_mean
        return self.prior_successes / (self.prior_successes + self.prior_failures)

    @property
    def settings(self) -> Settings:
        """With the rule of the likelihood."""
        settings = super().settings
        return settings._replace(rule=GAUSSIAN_THOMPSON) if self.is_gaussian else settings

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_option("likelihood", self.likelihood, Likelihood)
        check_finite([("prior_mean", self.prior_mean)])
        check_above_zero(
            (name, getattr(self, name))
            for name in ("prior_successes", "prior_failures", "prior_std", "reward_std")
        )

    def _parameters(self) -> tuple[float, float, float]:
        if self.is_gaussian:
            return self.prior_mean, self.prior_std**-2, self.reward_std**-2
        return self.prior_successes, self.prior_failures, 0.0

    def posterior(self, tables: Tables) -> NDArray[np.float64]:
        """What the agent believes of each arm's mean reward.

        Args:
            tables: sums and counts, of shape (...).

        Returns:
            The Beta distribution's two parameters, or mean and standard deviation of the normal
            one, shape (..., 2).
        """
        first, second, third = self._parameters()
        sums, counts = tables.sums, tables.counts
        if not self.is_gaussian:
            return np.stack([first + sums, second + counts - sums], axis=-1)
        precision: Any = second + third * counts
        return np.stack([(second * first + third * sums) / precision, precision**-0.5], axis=-1)
