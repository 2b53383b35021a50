"""Thompson sampling."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from rl_yardstick.agents.bandits.algorithm import ANY, BINARY
from rl_yardstick.agents.bandits.choosing import ScoreAgent, ScoreTables
from rl_yardstick.agents.bandits.tables import TableBandit
from rl_yardstick.agents.common.exploration import greedy_action
from rl_yardstick.agents.common.settings import FINITE, POSITIVE
from rl_yardstick.agents.compiled.generators import generator_of
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats

Likelihood = Literal["bernoulli", "gaussian"]


@inlined
def sample_posteriors(agent: ScoreAgent, row: int, progress: Any) -> int:
    """The arm whose draw from the posterior of its mean is the highest."""
    settings, tables, rng = agent.settings, agent.tables, generator_of(agent.rng)
    for arm in range(len(agent.arms)):
        count = tables.counts[row, arm]
        if settings.is_gaussian:
            precision = settings.prior_precision + count * settings.reward_precision
            deviation = 1.0 / math.sqrt(precision)
            agent.arms[arm] = tables.scores[row, arm] + deviation * rng.standard_normal()
        else:
            successes = tables.sums[row, arm]
            agent.arms[arm] = rng.beta(
                settings.prior_successes + successes, settings.prior_failures + count - successes
            )
    return greedy_action(agent.arms, 0.0)


@inlined
def update_mean(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """The score is the mean of the posterior."""
    settings, tables = agent.settings, agent.tables
    total, count = tables.sums[pull.row, pull.arm], tables.counts[pull.row, pull.arm]
    if settings.is_gaussian:
        weighted = (
            settings.prior_precision * settings.prior_mean + settings.reward_precision * total
        )
        precision = settings.prior_precision + settings.reward_precision * count
        tables.scores[pull.row, pull.arm] = weighted / precision
    else:
        prior = settings.prior_successes + settings.prior_failures
        tables.scores[pull.row, pull.arm] = (settings.prior_successes + total) / (prior + count)


class Thompson(TableBandit):
    """Thompson sampling: pulls an arm with the probability that it is best (Thompson, 1933).

    Args:
        args: as in `TableBandit`.
        likelihood: ``"bernoulli"``: rewards of 0 and 1 and a Beta prior; ``"gaussian"``: rewards
            with normal noise of a known deviation and a normal prior.
        prior_successes: first parameter of the Beta prior.
        prior_failures: second parameter of the Beta prior.
        prior_mean: of the normal prior.
        prior_std: standard deviation of the normal prior.
        reward_std: standard deviation of the noise.
        kwargs: as in `TableBandit`.
    """

    parameters = {  # noqa: RUF012
        "is_gaussian": np.bool_,
        "prior_successes": np.float64,
        "prior_failures": np.float64,
        "prior_mean": np.float64,
        "prior_precision": np.float64,
        "reward_precision": np.float64,
    }
    ranges = {  # noqa: RUF012
        "prior_mean": FINITE,
        **dict.fromkeys(("prior_successes", "prior_failures", "prior_std", "reward_std"), POSITIVE),
    }
    choose_arm = sample_posteriors
    learn_from_pull = update_mean

    hidden_arguments = ("learning_rate",)

    def __init__(
        self,
        *args: Any,
        likelihood: Likelihood = "bernoulli",
        prior_successes: float = 1.0,
        prior_failures: float = 1.0,
        prior_mean: float = 0.0,
        prior_std: float = 1.0,
        reward_std: float = 1.0,
        **kwargs: Any,
    ) -> None:
        self.likelihood = likelihood
        self.prior_successes = prior_successes
        self.prior_failures = prior_failures
        self.prior_mean = prior_mean
        self.prior_std = prior_std
        self.reward_std = reward_std
        super().__init__(*args, **kwargs)

    @property
    def is_gaussian(self) -> bool:
        """Whether rewards are assumed to have normal noise."""
        return self.likelihood == "gaussian"

    @property
    def rewards_known(self) -> str:  # type: ignore[override]
        """0 or 1 for a Bernoulli likelihood, any reward for a normal one."""
        return ANY if self.is_gaussian else BINARY

    @property
    def initial_score(self) -> float:  # type: ignore[override]
        """The mean of the prior."""
        if self.is_gaussian:
            return self.prior_mean
        return self.prior_successes / (self.prior_successes + self.prior_failures)

    @property
    def prior_precision(self) -> float:
        """One over the variance of the normal prior."""
        return self.prior_std**-2

    @property
    def reward_precision(self) -> float:
        """One over the variance of the noise."""
        return self.reward_std**-2

    def posterior(self, tables: ScoreTables) -> Floats:
        """The posterior of each arm's mean reward.

        Args:
            tables: sums and counts, of shape (...).

        Returns:
            The Beta distribution's two parameters, or mean and standard deviation of the normal
            one, shape (..., 2).
        """
        sums, counts = tables.sums, tables.counts
        if not self.is_gaussian:
            failures = self.prior_failures + counts - sums
            return np.stack([self.prior_successes + sums, failures], axis=-1)
        precision: Any = self.prior_precision + self.reward_precision * counts
        weighted = self.prior_precision * self.prior_mean + self.reward_precision * sums
        return np.stack([weighted / precision, precision**-0.5], axis=-1)
