"""What agents make of bandits: rewards and regrets by pull, where pulls went, what is believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.pull_statistics import QUANTILES, PullStatistics
from experiments.study_results import StudyResults
from pipeline.environments import make_single_env
from report.figures.posteriors import density, grid, is_normal, truth
from report.figures.regret_bounds import auer_bound, best_expected_reward, lai_robbins_slope
from report.page.sections import Report, Section

Floats = NDArray[np.float64]
Pulls = Mapping[str, PullStatistics]

MOST_ARMS = 40  # over all contexts, in a table or in a figure


@dataclass(frozen=True)
class ArmRow:
    """An arm in a context.

    Attributes:
        name: what it is called.
        mean: its true mean reward.
        regret: how far that is from the best in the context.
        shares: by agent, the share of the pulls in the context that went to it; nan where the agent
            never saw the context.
    """

    name: str
    mean: float
    regret: float
    shares: Mapping[str, float]


@dataclass(frozen=True)
class ContextTable:
    """Where the pulls went in one context.

    Attributes:
        name: what it is called; empty where it is the only one.
        rows: its arms.
        regrets: by agent, mean regret of a pull there.
    """

    name: str
    rows: list[ArmRow]
    regrets: Mapping[str, float]


def section(report: Report) -> Section | None:
    """Figures by pull of every bandit; None where there is none."""
    analysis = report.analysis
    by_environment = [_pulls_on(analysis, environment) for environment in analysis.environments]
    if not any(by_environment):
        return None
    data = [
        _environment_data(analysis.results, environment.environment, pulls) if pulls else None
        for environment, pulls in zip(analysis.environments, by_environment, strict=True)
    ]
    context = {
        "is_bandit": [bool(pulls) for pulls in by_environment],
        "tables": [context_tables(pulls) for pulls in by_environment],
        "agents": [list(pulls) for pulls in by_environment],
        "spread": f"{QUANTILES[-1] - QUANTILES[0]:.0%}",
        "has_bounds": any(item is not None and item["bounds"] for item in data),
    }
    return Section("bandits", "Pulls and regret", context, data, by_environment=True)


def _pulls_on(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> Pulls:
    """The figures by agent, the best agent first."""
    found = analysis.results.pulls
    keys = [(agent.agent, environment.environment) for agent in environment.agents]
    return {key[0]: found[key] for key in keys if key in found}


def context_tables(pulls: Pulls) -> list[ContextTable]:
    """Where the pulls went by context; none where true means differ between runs."""
    known = {agent: p for agent, p in pulls.items() if p.true_means.size}
    if not known:
        return []
    means = next(iter(known.values())).true_means
    if means.size > MOST_ARMS:
        return []
    gaps = means.max(axis=1, keepdims=True) - means
    tables = []
    for context in range(len(means)):
        rows = [
            ArmRow(
                name=f"arm {arm}",
                mean=float(means[context, arm]),
                regret=float(gaps[context, arm]),
                shares={agent: float(p.shares[context, arm]) for agent, p in known.items()},
            )
            for arm in range(means.shape[1])
        ]
        regrets = {agent: float(p.shares[context] @ gaps[context]) for agent, p in known.items()}
        tables.append(ContextTable(f"context {context}" if len(means) > 1 else "", rows, regrets))
    return tables


def _environment_data(results: StudyResults, environment: str, pulls: Pulls) -> dict[str, Any]:
    run = next(p for p in results.planned if p.environment == environment)
    env = make_single_env(run.spec)
    try:
        best, bounds = best_expected_reward(env), _bounds(env, next(iter(pulls.values())))
    finally:
        env.close()
    return {
        "best": best,
        "bounds": bounds,
        "curves": {agent: _curves(statistics) for agent, statistics in pulls.items()},
        "arms": _arms(pulls),
        "posteriors": [
            _posteriors(results, agent, statistics)
            for agent, statistics in pulls.items()
            if statistics.true_means.size and len(statistics.moments)
        ],
    }


def _curves(statistics: PullStatistics) -> dict[str, Any]:
    mean, reach = statistics.cumulative_regret, 1.96 * statistics.cumulative_regret_sem
    low, *_, high = statistics.cumulative_regret_quantiles
    median = statistics.cumulative_regret_quantiles[QUANTILES.index(0.5)]
    return {
        "x": statistics.pulls,
        "reward": statistics.reward,
        "optimal": statistics.optimal,
        "regret": {
            "mean": {"y": mean, "low": mean - reach, "high": mean + reach},
            "runs": {"y": median, "low": low, "high": high},
        },
        "simple": statistics.simple_regret,
    }


def _bounds(env: gym.Env[Any, Any], statistics: PullStatistics) -> dict[str, Any] | None:
    """What theory says of a single row of Bernoulli arms that stay as they are."""
    bandit: Any = env.unwrapped
    means = statistics.true_means
    if bandit.kind != "clicks" or len(means) != 1 or means.max() == means.min():
        return None
    return {
        "x": statistics.pulls,
        "auer": auer_bound(means[0], statistics.pulls),
        "lai_robbins": lai_robbins_slope(means[0]) * np.log(statistics.pulls),
    }


def _arms(pulls: Pulls) -> dict[str, Any] | None:
    """True means and final estimates, context by context."""
    known = {agent: p for agent, p in pulls.items() if p.true_means.size}
    if not known:
        return None
    means = next(iter(known.values())).true_means
    if means.size > MOST_ARMS:
        return None
    contexts, arms = means.shape
    return {
        "names": [
            f"arm {arm}" if contexts == 1 else f"context {context}, arm {arm}"
            for context in range(contexts)
            for arm in range(arms)
        ],
        "means": means.ravel(),
        "shares": {agent: statistics.shares.ravel() for agent, statistics in known.items()},
        "estimates": {
            agent: {
                "mean": np.broadcast_to(statistics.estimates, means.shape).ravel(),
                "std": np.broadcast_to(statistics.estimates_std, means.shape).ravel(),
            }
            for agent, statistics in known.items()
            if np.isfinite(statistics.estimates).any()
        },
    }


def _posteriors(results: StudyResults, agent: str, statistics: PullStatistics) -> dict[str, Any]:
    """Densities by moment, context and arm."""
    normal = is_normal(results, agent)
    x = grid(statistics.true_means, is_normal=normal)
    _, contexts, arms, _ = statistics.posteriors.shape
    return {
        "agent": agent,
        "moments": statistics.moments,
        "x": x,
        "truth": [[truth(statistics, c, arm) for arm in range(arms)] for c in range(contexts)],
        "densities": [
            [[density(parameters, x, is_normal=normal) for parameters in row] for row in moment]
            for moment in statistics.posteriors
        ],
    }
