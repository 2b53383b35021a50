"""Upper confidence bounds: UCB1 and its variants, and KL-UCB."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from rl_yardstick.agents.bandits.algorithm import UNIT
from rl_yardstick.agents.bandits.choosing import ScoreAgent, total_count
from rl_yardstick.agents.bandits.tables import TableBandit
from rl_yardstick.agents.common.exploration import greedy_action
from rl_yardstick.agents.common.settings import NOT_NEGATIVE
from rl_yardstick.agents.compiled.generators import generator_of
from rl_yardstick.agents.compiled.loop import CompiledOnlyError, by_type
from rl_yardstick.machine_code.compiling import inlined

# The base of agents that pull the arm of the highest upper confidence bound.


@by_type
def upper_bound(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """The bound of an arm after ``count`` of ``pulls`` pulls."""
    raise CompiledOnlyError


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
    total, count = tables.sums[pull.row, pull.arm], tables.counts[pull.row, pull.arm]
    tables.scores[pull.row, pull.arm] = total / count


class UpperBoundBandit(TableBandit):
    """Pulls each arm once, then the one of the highest bound; subclasses set `upper_bound`."""

    choose_arm = highest_bound
    learn_from_pull = average_rewards
    initial_score = -math.inf  # below that of any arm that was tried


# Upper confidence bounds.

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
        args: as in `TableBandit`.
        variant: ``"ucb1"``: mean + c sqrt(2 ln t / n) after t pulls; ``"sutton_barto"``: mean +
            c sqrt(ln t / n) at the t-th pull.
        c: degree of exploration; by default 1 for UCB1 and 2 for Sutton and Barto's.
        kwargs: as in `TableBandit`.
    """

    parameters = {"width": np.float64, "is_textbook": np.bool_}  # noqa: RUF012
    ranges = {"c": NOT_NEGATIVE}  # noqa: RUF012
    upper_bound = ucb_bound

    hidden_arguments = ("learning_rate",)

    def __init__(
        self, *args: Any, variant: Variant = "ucb1", c: float | None = None, **kwargs: Any
    ) -> None:
        self.variant = variant
        self.c = c
        super().__init__(*args, **kwargs)

    @property
    def is_textbook(self) -> bool:
        """Whether the bound is Sutton and Barto's."""
        return self.variant == "sutton_barto"

    @property
    def width(self) -> float:
        """The degree of exploration ``c``, or its default."""
        default = 2.0 if self.is_textbook else 1.0
        return default if self.c is None else self.c


# Upper confidence bounds by the divergence of Bernoulli distributions.

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
    """Upper confidence bounds by the divergence of Bernoulli distributions.

    Each arm is pulled once first. Rewards must be in [0, 1]. Source: Garivier and Cappe (2011).

    Args:
        args: as in `TableBandit`.
        c: of the bound's ln t + c ln ln t; the authors prove with 3 and recommend 0.
        kwargs: as in `TableBandit`.
    """

    parameters = {"c": np.float64}  # noqa: RUF012
    ranges = {"c": NOT_NEGATIVE}  # noqa: RUF012
    rewards_known = UNIT
    upper_bound = kl_ucb_bound

    hidden_arguments = ("learning_rate",)

    def __init__(self, *args: Any, c: float = 0.0, **kwargs: Any) -> None:
        self.c = c
        super().__init__(*args, **kwargs)
