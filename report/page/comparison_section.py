"""How the agents of an environment differ: intervals, pairs, and who beats whom."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.seed_values import values_over_seeds
from experiments.study_spec import COSTS, METRIC_WORDS
from report.page.scales import linear_up_to
from report.page.sections import Report, Section, estimate_data
from verdicts import Verdict

PHRASES: dict[Verdict, str] = {
    "better": "is better than",
    "worse": "is worse than",
    "equivalent": "is equivalent to",
    "undecided": "cannot be told from",
}


# A page with more runs than this of each agent shows their means alone.
MOST_DOTS = 300


def section(report: Report) -> Section | None:
    """Intervals and each run as figures, the pairs as a table and as a matrix."""
    analysis = report.analysis
    metric = METRIC_WORDS[analysis.study.metric]
    data = {
        "metric": metric,
        "environments": [_data(analysis, environment) for environment in analysis.environments],
    }
    context = {
        "metric": metric,
        "phrases": PHRASES,
        "most_dots": MOST_DOTS,
        "lower_is_better": analysis.study.metric in COSTS,
    }
    return Section("comparison", "Differences", context, data, by_environment=True)


def _data(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> dict[str, Any]:
    values = values_over_seeds(analysis.results, environment.environment, analysis.study.metric)
    agents = [agent.agent for agent in environment.agents]
    return {
        "intervals": [
            {
                "agent": agent.agent,
                **estimate_data(agent.metric.mean),
                **_runs(values[agent.agent]),
            }
            for agent in environment.agents
        ],
        "linearUpTo": linear_up_to((values[agent] for agent in agents), environment.optimum),
        "agents": agents,
        "improvement": improvement_matrix(environment),
    }


def _runs(values: NDArray[np.float64]) -> dict[str, Any]:
    """Each run, where they are not too many to be told apart."""
    seeds = np.flatnonzero(np.isfinite(values))
    if len(values) > MOST_DOTS:
        seeds = seeds[:0]
    return {"seeds": seeds, "runs": values[seeds]}


def improvement_matrix(environment: EnvironmentAnalysis) -> list[list[float | None]]:
    """The probability that a run of the row's agent beats one of the column's, None on itself."""
    chances: dict[tuple[str, str], float] = {}
    for pair in environment.pairs:
        for seen in (pair, pair.swapped()):
            chances[seen.first, seen.second] = seen.probability_of_improvement.point
    agents = [agent.agent for agent in environment.agents]
    return [[chances.get((row, column)) for column in agents] for row in agents]
