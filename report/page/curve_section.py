"""Learning curves of all agents, by step, episode and wall time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from report.page.sections import Report, Section
from report.series.curve_series import Curve, LearningCurves

STAGES = (0.1, 0.25, 0.5, 1.0)  # shares of an agent's training that the table has a column for


def section(report: Report) -> Section | None:
    """The curves of every environment, kind and axis, as the script chooses among them.

    Bandits have theirs by pull, in a section of their own.
    """
    curves = [one.curves for one in report.series.environments]
    if report.analysis.results.curves.empty or not any(curves):
        return None
    context = {
        "has_curves": [item is not None for item in curves],
        "stages": STAGES,
        "tables": [[] if item is None else _table(item["evaluation"]) for item in curves],
    }
    data = [None if item is None else _environment_data(item) for item in curves]
    return Section("curves", "Learning curves", context, places=data, by_environment=True)


def _environment_data(curves: Mapping[str, LearningCurves]) -> dict[str, Any]:
    return {
        kind: {
            "linearUpTo": of_kind.linear_up_to,
            "onVariant": of_kind.on_variant,
            **{
                by: {agent: vars(curve) for agent, curve in of_agents.items()}
                for by, of_agents in of_kind.by_axis.items()
            },
        }
        for kind, of_kind in curves.items()
    }


def _table(evaluations: LearningCurves) -> list[tuple[str, list[dict[str, float]]]]:
    """What an agent's curve comes to by each stage: for those who cannot see the figure."""
    curves = evaluations.by_axis["step"]
    return [(agent, [_at(curve, share) for share in STAGES]) for agent, curve in curves.items()]


def _at(curve: Curve, share: float) -> dict[str, float]:
    """The point of a curve that lies nearest to a share of its way."""
    nearest = np.abs(curve.x - share * curve.x[-1]).argmin()
    return {name: values[nearest] for name, values in vars(curve).items()}
