"""Rules of bandit agents on tables: upper confidence bounds, posteriors, preferences."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule

from rl_yardstick.agents.bandits.algorithm import ANY, BINARY, UNIT
from rl_yardstick.agents.bandits.choosing import (
    ScoreAgent,
    ScoreTables,
    count_reward,
    mean_reward,
    total_count,
)
from rl_yardstick.agents.bandits.tables import TableBandit
from rl_yardstick.agents.common.exploration import (
    BOLTZMANN,
    action_probabilities,
    boltzmann_action,
    drawn_action,
    greedy_action,
    make_probabilities,
)
from rl_yardstick.agents.common.settings import FINITE, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE
from rl_yardstick.agents.compiled.loop import by_type
from rl_yardstick.agents.compiled.references import generator_of
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats


@by_type
def upper_bound(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """The bound of an arm after ``count`` of ``pulls`` pulls."""
    raise NotImplementedError


@inlined
def highest_bound(agent: ScoreAgent, row: int, progress: Any) -> int:
    """An arm of the highest bound; the bound of an untried arm is infinite."""
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
    count_reward(tables, pull)
    total, count = tables.sums[pull.row, pull.arm], tables.counts[pull.row, pull.arm]
    tables.scores[pull.row, pull.arm] = total / count


class UpperBoundBandit(TableBandit):
    """Pulls each arm once, then the one of the highest bound; subclasses set `upper_bound`."""

    choose_arm = highest_bound
    learn_from_reward = average_rewards
    initial_score = -math.inf  # below that of any arm that was tried


Variant = Literal["ucb1", "sutton_barto"]
SUTTON_BARTO = 1


@inlined
def ucb_index(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """Mean plus width sqrt(2 ln t / n) after t pulls, or width sqrt(ln t / n) at the t-th pull.

    The first is UCB1 (Auer et al., 2002), the second Sutton and Barto's, section 2.7.
    """
    factor, offset = (1.0, 1.0) if agent.settings.variant == SUTTON_BARTO else (2.0, 0.0)
    return float(mean + agent.settings.width * math.sqrt(factor * math.log(pulls + offset) / count))


class UCB(UpperBoundBandit):
    """Upper confidence bounds: UCB1 (Auer et al., 2002), or as Sutton and Barto, section 2.7.

    Each arm is pulled once before any bound counts.

    Args:
        variant: ``"ucb1"``: mean + c sqrt(2 ln t / n) after t pulls; ``"sutton_barto"``: mean +
            c sqrt(ln t / n) at the t-th pull.
        c: degree of exploration; by default 1 for UCB1 and 2 for Sutton and Barto's.
    """

    parameters = {"width": np.float64, "variant": np.int64}  # noqa: RUF012
    ranges = {"c": NOT_NEGATIVE}  # noqa: RUF012
    upper_bound = ucb_index

    hidden_arguments = ("learning_rate",)

    def __init__(
        self, *args: Any, variant: Variant = "ucb1", c: float | None = None, **kwargs: Any
    ) -> None:
        self.variant = variant
        self.c = c
        super().__init__(*args, **kwargs)

    @property
    def width(self) -> float:
        """The degree of exploration ``c``, or its default."""
        default = 2.0 if self.variant == "sutton_barto" else 1.0
        return default if self.c is None else self.c


MAX_NEWTON_STEPS = 60
PRECISION = 1e-13
LAST_BELOW_ONE = 1.0 - 2.0**-53


@inlined
def bernoulli_kl(p: float, q: float) -> float:
    """Kullback-Leibler divergence of Bernoulli(``p``) from Bernoulli(``q``), ``q`` in (0, 1)."""
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
    solution. Pinsker's inequality gives the starting point.
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
def kl_ucb_index(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """The highest q with count * kl(mean, q) <= ln(pulls) + c ln(ln(pulls)).

    Source: Garivier and Cappe, 2011.
    """
    log_pulls, c = math.log(pulls), agent.settings.c
    return kl_upper_bound(mean, (log_pulls + c * math.log(max(log_pulls, 1.0))) / count)


class KLUCB(UpperBoundBandit):
    """Upper confidence bounds by the divergence of Bernoulli distributions.

    Each arm is pulled once first. Rewards must be in [0, 1]. Source: Garivier and Cappe (2011).

    Args:
        c: of the bound's ln t + c ln ln t; the authors prove with 3 and recommend 0.
    """

    parameters = {"c": np.float64}  # noqa: RUF012
    ranges = {"c": NOT_NEGATIVE}  # noqa: RUF012
    rewards_known = UNIT
    upper_bound = kl_ucb_index

    hidden_arguments = ("learning_rate",)

    def __init__(self, *args: Any, c: float = 0.0, **kwargs: Any) -> None:
        self.c = c
        super().__init__(*args, **kwargs)


Likelihood = Literal["bernoulli", "gaussian"]
GAUSSIAN = 1


@inlined
def sample_posteriors(agent: ScoreAgent, row: int, progress: Any) -> int:
    """The arm whose draw from the posterior of its mean is the highest."""
    settings, tables, rng = agent.settings, agent.tables, generator_of(agent.rng)
    for arm in range(len(agent.arms)):
        count = tables.counts[row, arm]
        if settings.likelihood == GAUSSIAN:
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
    count_reward(tables, pull)
    total, count = tables.sums[pull.row, pull.arm], tables.counts[pull.row, pull.arm]
    if settings.likelihood == GAUSSIAN:
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
        likelihood: ``"bernoulli"``: rewards of 0 and 1 and a Beta prior; ``"gaussian"``: rewards
            with normal noise of a known deviation and a normal prior.
        prior_successes: first parameter of the Beta prior.
        prior_failures: second parameter of the Beta prior.
        prior_mean: of the normal prior.
        prior_std: standard deviation of the normal prior.
        reward_std: standard deviation of the noise.
    """

    parameters = {  # noqa: RUF012
        "likelihood": np.int64,
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
    learn_from_reward = update_mean

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
    def rewards_known(self) -> str:  # type: ignore[override]
        """0 or 1 for a Bernoulli likelihood, any reward for a normal one."""
        return ANY if self.likelihood == "gaussian" else BINARY

    @property
    def initial_score(self) -> float:  # type: ignore[override]
        """The mean of the prior."""
        if self.likelihood == "gaussian":
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
        if self.likelihood != "gaussian":
            failures = self.prior_failures + counts - sums
            return np.stack([self.prior_successes + sums, failures], axis=-1)
        precision: Any = self.prior_precision + self.reward_precision * counts
        weighted = self.prior_precision * self.prior_mean + self.reward_precision * sums
        return np.stack([weighted / precision, precision**-0.5], axis=-1)


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
        means = np.full(tables.sums.shape, np.nan)
        np.divide(tables.sums, tables.counts, out=means, where=tables.counts > 0)
        return means

    def action_probabilities(self, observations: NDArray[Any]) -> Floats:
        """The probabilities of arms now at each of n observations, shape (n, arms)."""
        scores = self.policy.judged(observations)
        return action_probabilities(BOLTZMANN, scores, 1.0, random_ties=False)


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
    count_reward(tables, pull)


class GradientBandit(PreferenceBandit):
    """Gradient ascent on preferences (Sutton and Barto, section 2.8).

    Args:
        learning_rate: step size, constant or scheduled.
        baseline: compare a reward with the average of those before it, as in the book's second
            edition (its drafts included the reward itself); else with 0.
    """

    parameters = {"baseline": np.bool_}  # noqa: RUF012
    choose_arm = choose_by_preference
    learn_from_reward = gradient_step

    def __init__(
        self,
        *args: Any,
        learning_rate: float | Schedule = 0.1,
        baseline: bool = True,
        **kwargs: Any,
    ) -> None:
        self.baseline = baseline
        super().__init__(*args, learning_rate=learning_rate, **kwargs)


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
    count_reward(agent.tables, pull)
    share = agent.settings.mixing * pull.reward
    agent.tables.scores[pull.row, pull.arm] += share / (pull.probability * len(agent.arms))


class Exp3(PreferenceBandit):
    """Exponential weights for rewards that an adversary may choose (Auer et al., 2002).

    Rewards lie between 0 and 1.

    Args:
        mixing: share of uniformly random pulls, in (0, 1]; the paper's gamma.
    """

    parameters = {"mixing": np.float64}  # noqa: RUF012
    ranges = {"mixing": POSITIVE_SHARE}  # noqa: RUF012
    rewards_known = UNIT
    choose_arm = draw_by_weight
    choice_probability = probability_of
    learn_from_reward = raise_weight

    hidden_arguments = ("learning_rate",)

    def __init__(self, *args: Any, mixing: float = 0.1, **kwargs: Any) -> None:
        self.mixing = mixing
        super().__init__(*args, **kwargs)

    def action_probabilities(self, observations: NDArray[Any]) -> Floats:
        """As above, mixed with uniform."""
        softmax = super().action_probabilities(observations)
        return (1.0 - self.mixing) * softmax + self.mixing / self.n_arms
