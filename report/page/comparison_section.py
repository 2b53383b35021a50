"""How the agents of an environment differ: intervals, pairs, and who beats whom."""

from __future__ import annotations

from typing import Any

from experiments.analysis import EnvironmentAnalysis
from experiments.study_spec import COSTS, METRIC_WORDS
from report.page.sections import Report, Section, estimate_data
from report.series.run_series import AgentRuns
from report.series.study_series import EnvironmentSeries
from report.verdict_matrix import PHRASES

# A page with more runs than this of each agent shows their means alone.
MOST_DOTS = 300


def section(report: Report) -> Section | None:
    """Intervals and each run as figures, the pairs as a table and as a matrix."""
    analysis = report.analysis
    metric = METRIC_WORDS[analysis.study.metric]
    context = {
        "metric": metric,
        "phrases": PHRASES,
        "most_dots": MOST_DOTS,
        "lower_is_better": analysis.study.metric in COSTS,
        "matrices": [improvement_matrix(one) for one in analysis.environments],
    }
    places = [_data(one) for one in report.series.environments]
    return Section(
        "comparison", "Differences", context, {"metric": metric}, places, by_environment=True
    )


def _data(one: EnvironmentSeries) -> dict[str, Any]:
    return {
        "intervals": [_runs(agent) for agent in one.runs.agents],
        "linearUpTo": one.runs.linear_up_to,
    }


def _runs(agent: AgentRuns) -> dict[str, Any]:
    """The mean, and each run where they are not too many to be told apart."""
    many = len(agent.values) > MOST_DOTS
    return {
        "agent": agent.agent,
        **estimate_data(agent.mean),
        "seeds": agent.seeds[:0] if many else agent.seeds,
        "runs": agent.values[:0] if many else agent.values,
    }


def improvement_matrix(environment: EnvironmentAnalysis) -> list[list[float | None]]:
    """The probability that a run of the row's agent beats one of the column's, None on itself."""
    chances: dict[tuple[str, str], float] = {}
    for pair in environment.pairs:
        for seen in (pair, pair.swapped()):
            chances[seen.first, seen.second] = seen.probability_of_improvement.point
    agents = [agent.agent for agent in environment.agents]
    return [[chances.get((row, column)) for column in agents] for row in agents]
