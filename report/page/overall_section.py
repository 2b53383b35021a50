"""The agents over all environments, by scores that environments share."""

from __future__ import annotations

from typing import Any

from experiments.analysis import StudyAnalysis
from experiments.overall_analysis import OverallAnalysis
from report.page.sections import Report, Section, estimate_data
from verdicts import Estimate


def section(report: Report) -> Section | None:
    """Aggregates, profiles and the score on each environment; None for a single environment."""
    overall = report.analysis.overall
    if overall is None:
        return None
    agents = list(overall.scores)
    context = {
        "agents": agents,
        "scores": _scores(report.analysis, agents),
        "improvement": [
            [overall.improvement[one, two].point if one != two else None for two in agents]
            for one in agents
        ],
    }
    return Section("overall", "Overall", context, _data(overall))


def _data(overall: OverallAnalysis) -> dict[str, Any]:
    agents = list(overall.scores)
    return {
        "agents": agents,
        "iqm": [{"agent": agent, **estimate_data(overall.scores[agent].iqm)} for agent in agents],
        "thresholds": overall.thresholds,
        "profiles": {
            agent: {"y": band.point, "low": band.low, "high": band.high}
            for agent, band in overall.profiles.items()
        },
    }


def _scores(analysis: StudyAnalysis, agents: list[str]) -> list[dict[str, Estimate]]:
    """The mean score by agent, for each environment."""
    return [
        {
            agent.agent: agent.score.mean
            for agent in environment.agents
            if agent.score is not None and agent.agent in agents
        }
        for environment in analysis.environments
    ]
