"""Learning curves of all agents, by step, episode and wall time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.seed_values import mean_curve
from report.page.scales import linear_up_to
from report.page.sections import Report, Section
from verdicts import Band

KINDS = ("evaluation", "training")
AXES = ("step", "episode", "seconds")
MAX_POINTS = 200  # more than a screen tells apart
STAGES = (0.1, 0.25, 0.5, 1.0)  # shares of an agent's training that the table has a column for

Floats = NDArray[np.float64]
Curve = tuple[Floats, Band]


def section(report: Report) -> Section | None:
    """The curves of every environment, kind and axis, as the script chooses among them.

    Bandits have theirs by pull, in a section of their own.
    """
    analysis = report.analysis
    bandits = {environment for _, environment in analysis.results.pulls}
    data = [
        None if environment.environment in bandits else _environment_data(analysis, environment)
        for environment in analysis.environments
    ]
    if analysis.results.curves.empty or not any(data):
        return None
    context = {
        "has_curves": [item is not None for item in data],
        "stages": STAGES,
        "tables": [[] if item is None else _table(item["evaluation"]["step"]) for item in data],
    }
    return Section("curves", "Learning curves", context, data, by_environment=True)


def _environment_data(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for kind in KINDS:
        curves = {
            by: {
                agent.agent: curve
                for agent in environment.agents
                if (curve := _curve(analysis, environment, agent.agent, kind, by)) is not None
            }
            for by in AXES
        }
        data[kind] = {
            "linearUpTo": linear_up_to(
                [band.point for _, band in curves["step"].values()], environment.optimum
            ),
            **{
                by: {agent: _curve_data(curve) for agent, curve in of_agents.items()}
                for by, of_agents in curves.items()
            },
        }
    return data


def _curve(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, agent: str, kind: str, by: str
) -> Curve | None:
    try:
        return mean_curve(analysis.results, environment.environment, agent, kind, by)
    except ValueError:
        # Runs that were never evaluated, or whose wall times do not overlap, share no curve.
        return None


def _curve_data(curve: Curve) -> dict[str, Floats]:
    points, band = curve
    chosen = np.arange(len(points))
    if len(points) > MAX_POINTS:
        chosen = np.linspace(0, len(points) - 1, MAX_POINTS).round().astype(np.int64)
    return {
        "x": points[chosen],
        "y": band.point[chosen],
        "low": band.low[chosen],
        "high": band.high[chosen],
    }


def _table(curves: Mapping[str, Mapping[str, Floats]]) -> list[tuple[str, list[dict[str, float]]]]:
    """What an agent's curve comes to by each stage: for those who cannot see the figure."""
    return [(agent, [_at(curve, share) for share in STAGES]) for agent, curve in curves.items()]


def _at(curve: Mapping[str, Floats], share: float) -> dict[str, float]:
    """The point of a curve that lies nearest to a share of its way."""
    nearest = np.abs(curve["x"] - share * curve["x"][-1]).argmin()
    return {name: values[nearest] for name, values in curve.items()}
