"""Figures and learning curves of agents over their seeds."""

from __future__ import annotations

import numpy as np

from experiments.study_results import StudyResults
from mdp.array_types import Floats
from verdicts import Band, curve_band, on_grid, shared_grid

RESAMPLING_SEED = 0  # the same runs give the same figures
CURVE_POINTS = 200


def values_over_seeds(results: StudyResults, environment: str, column: str) -> dict[str, Floats]:
    """A column of the summary by agent, shape (n_seeds,); NaN where a run is missing."""
    table = results.summary
    table = table[table["environment"] == environment]
    pivot = table.pivot(index="seed", columns="agent", values=column)
    pivot = pivot.reindex(
        index=results.study.seeds, columns=[a.label for a in results.study.agents]
    )
    return {str(agent): pivot[agent].to_numpy(dtype=np.float64, na_value=np.nan) for agent in pivot}


def mean_curve(
    results: StudyResults, environment: str, agent: str, kind: str, by: str
) -> tuple[Floats, Band] | None:
    """The mean learning curve of an agent over its seeds.

    Args:
        results: the runs.
        environment: label of the environment.
        agent: label of the agent.
        kind: ``"evaluation"`` or ``"training"``.
        by: ``"step"``, ``"episode"`` or ``"seconds"``.

    Returns:
        The points, shape (n,), and the mean there with its interval; None without any run, or where
        one ended before the first point of another.
    """
    table = results.curves
    chosen = (table["environment"] == environment) & (table["agent"] == agent)
    runs = [
        (rows[by].to_numpy(dtype=np.float64), rows["value"].to_numpy(dtype=np.float64))
        for _, rows in table[chosen & (table["kind"] == kind)].groupby("seed")
    ]
    if not runs or max(points[0] for points, _ in runs) > min(points[-1] for points, _ in runs):
        return None
    grid = shared_grid([points for points, _ in runs], CURVE_POINTS)
    values = np.array([on_grid(points, returns, grid) for points, returns in runs])
    return grid, curve_band(values, seed=RESAMPLING_SEED)
