"""What agents make of bandits: rewards and regrets by pull, where pulls went, what is believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from experiments.bandits import PullStatistics
from report.page.sections import Report, Section
from report.series.curve_series import Curve
from report.series.posteriors import Belief
from report.series.pull_series import (
    SPREAD,
    ArmSeries,
    Pulls,
    PullSeries,
    mean_regret,
    regret_of_runs,
)

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
    bandits = [one.pulls for one in report.series.environments]
    if not any(bandits):
        return None
    data = [None if series is None else _environment_data(series) for series in bandits]
    pulls = [{} if series is None else series.pulls for series in bandits]
    context = {
        "is_bandit": [series is not None for series in bandits],
        "tables": [context_tables(of_agents) for of_agents in pulls],
        "agents": [list(of_agents) for of_agents in pulls],
        "spread": SPREAD,
        "has_bounds": any(series is not None and series.bounds for series in bandits),
    }
    return Section("bandits", "Pulls and regret", context, places=data, by_environment=True)


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


def _environment_data(series: PullSeries) -> dict[str, Any]:
    bounds = series.bounds
    return {
        "best": series.best,
        "bounds": None
        if bounds is None
        else {"x": bounds.pulls, "auer": bounds.auer, "lai_robbins": bounds.lai_robbins},
        "curves": {agent: _curves(statistics) for agent, statistics in series.pulls.items()},
        "arms": _arms(series.arms),
        "posteriors": [_belief(belief) for belief in series.beliefs],
    }


def _curves(statistics: PullStatistics) -> dict[str, Any]:
    return {
        "x": statistics.pulls,
        "reward": statistics.reward,
        "optimal": statistics.optimal,
        "regret": {
            "mean": _band(mean_regret(statistics)),
            "runs": _band(regret_of_runs(statistics)),
        },
        "simple": statistics.simple_regret,
    }


def _band(curve: Curve) -> dict[str, Any]:
    return {"y": curve.y, "low": curve.low, "high": curve.high}


def _arms(arms: ArmSeries | None) -> dict[str, Any] | None:
    if arms is None or len(arms.names) > MOST_ARMS:
        return None
    estimates = {agent: {"mean": m, "std": std} for agent, (m, std) in arms.estimates.items()}
    return {
        "names": arms.names,
        "means": arms.means,
        "shares": arms.shares,
        "estimates": estimates,
    }


def _belief(belief: Belief) -> dict[str, Any]:
    """Densities by moment, context and arm."""
    return {
        "agent": belief.agent,
        "moments": belief.moments,
        "x": belief.points,
        "truth": belief.true_means,
        "densities": belief.densities,
    }
