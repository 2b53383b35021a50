"""What agents make of a bandit: regrets by pull, where pulls went, what is believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.analysis import EnvironmentAnalysis
from experiments.bandits import QUANTILES, PullStatistics
from experiments.results import StudyResults
from mdp.array_types import Floats, Ints
from pipeline.environments import make_single_env
from report.series.curve_series import Curve
from report.series.posteriors import Belief, belief
from report.series.regret_bounds import auer_bound, best_expected_reward, lai_robbins_slope

SPREAD = f"{QUANTILES[-1] - QUANTILES[0]:.0%}"  # of the runs lie between the outer quantiles

Pulls = Mapping[str, PullStatistics]


@dataclass(frozen=True)
class RegretBounds:
    """What theory says of the regret, each of shape (n_points,)."""

    pulls: Ints
    auer: Floats
    lai_robbins: Floats


@dataclass(frozen=True)
class ArmSeries:
    """Arms in the order of contexts, each array of shape (n_contexts * n_arms,).

    Attributes:
        n_contexts: how many.
        names: what the arms are called.
        means: their true mean rewards.
        shares: by agent, the share of the pulls in the context that went to them.
        estimates: by agent that has some, final estimates of the means, mean and standard deviation
            over runs.
    """

    n_contexts: int
    names: list[str]
    means: Floats
    shares: Mapping[str, Floats]
    estimates: Mapping[str, tuple[Floats, Floats]]


@dataclass(frozen=True)
class PullSeries:
    """What there is to draw of a bandit.

    Attributes:
        pulls: figures by pull of each agent, the best first.
        best: the highest expected reward of a pull, where it is known.
        bounds: for a single row of Bernoulli arms that stay as they are; else None.
        arms: None where arms differ between runs.
        beliefs: of the agents that have some.
    """

    pulls: Pulls
    best: float | None
    bounds: RegretBounds | None
    arms: ArmSeries | None
    beliefs: tuple[Belief, ...]

    @property
    def n_runs(self) -> int:
        """How many runs the figures are over."""
        return len(next(iter(self.pulls.values())).total_reward)

    @property
    def has_simple_regret(self) -> bool:
        """Whether some agent has a simple regret."""
        return any(np.isfinite(found.simple_regret).any() for found in self.pulls.values())


def pull_series(results: StudyResults, environment: EnvironmentAnalysis) -> PullSeries | None:
    """What there is to draw of an environment; None where it is no bandit."""
    label = environment.environment
    pulls = {
        agent.agent: results.pulls[agent.agent, label]
        for agent in environment.agents
        if (agent.agent, label) in results.pulls
    }
    if not pulls:
        return None
    env = make_single_env(next(p for p in results.planned if p.environment == label).spec)
    try:
        best, bounds = best_expected_reward(env), regret_bounds(env, next(iter(pulls.values())))
    finally:
        env.close()
    known = {agent: found for agent, found in pulls.items() if found.true_means.size}
    beliefs = [belief(results, agent, p) for agent, p in known.items() if len(p.moments)]
    return PullSeries(pulls, best, bounds, arm_series(known), tuple(beliefs))


def mean_regret(statistics: PullStatistics) -> Curve:
    """Cumulative regret: the mean over runs with its 95 % interval."""
    mean, reach = statistics.cumulative_regret, 1.96 * statistics.cumulative_regret_sem
    return Curve(statistics.pulls.astype(np.float64), mean, mean - reach, mean + reach)


def regret_of_runs(statistics: PullStatistics) -> Curve:
    """Cumulative regret: the median run between the outer quantiles."""
    low, *_, high = statistics.cumulative_regret_quantiles
    median = statistics.cumulative_regret_quantiles[QUANTILES.index(0.5)]
    return Curve(statistics.pulls.astype(np.float64), median, low, high)


def regret_bounds(env: gym.Env[Any, Any], statistics: PullStatistics) -> RegretBounds | None:
    """What theory says beforehand, where its conditions hold."""
    bandit: Any = env.unwrapped
    means, pulls = statistics.true_means, statistics.pulls
    if bandit.kind != "clicks" or len(means) != 1 or means.max() == means.min():
        return None
    slope = lai_robbins_slope(means[0])
    return RegretBounds(pulls, auer_bound(means[0], pulls), slope * np.log(pulls))


def arm_series(known: Pulls) -> ArmSeries | None:
    """Shares and estimates of agents on arms that all runs share; None without such an agent."""
    if not known:
        return None
    means = next(iter(known.values())).true_means
    contexts, arms = means.shape
    return ArmSeries(
        n_contexts=contexts,
        names=[
            f"arm {arm}" if contexts == 1 else f"context {context}, arm {arm}"
            for context in range(contexts)
            for arm in range(arms)
        ],
        means=means.ravel(),
        shares={agent: statistics.shares.ravel() for agent, statistics in known.items()},
        estimates={
            agent: (
                np.broadcast_to(statistics.estimates, means.shape).ravel(),
                np.broadcast_to(statistics.estimates_std, means.shape).ravel(),
            )
            for agent, statistics in known.items()
            if np.isfinite(statistics.estimates).any()
        },
    )
