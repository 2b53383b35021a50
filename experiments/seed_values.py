"""Figures and learning curves of agents over their seeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from experiments.run_curves import TRAINING_POINTS
from experiments.study_results import StudyResults
from mdp.array_types import Floats
from verdicts import Band, curve_band, on_grid, shared_grid

RESAMPLING_SEED = 0  # the same runs give the same figures
CURVE_POINTS = TRAINING_POINTS  # no run has more of training; a figure shows no more of them


def values_over_seeds(results: StudyResults, environment: str, column: str) -> dict[str, Floats]:
    """A column of the summary by agent, shape (n_seeds,); NaN where a run is missing."""
    table = results.summary
    table = table[table["environment"] == environment]
    pivot = table.pivot(index="seed", columns="agent", values=column)
    pivot = pivot.reindex(
        index=results.study.seeds, columns=[a.label for a in results.study.agents]
    )
    return {str(agent): pivot[agent].to_numpy(dtype=np.float64, na_value=np.nan) for agent in pivot}


def curves_by_agent(
    results: StudyResults, environment: str
) -> dict[tuple[str, str], list[pd.DataFrame]]:
    """The learning curve of each run on an environment, by agent and kind."""
    table = results.curves
    table = table[table["environment"] == environment]
    found: dict[tuple[str, str], list[pd.DataFrame]] = {}
    for (agent, kind, _), rows in table.groupby(["agent", "kind", "seed"]):
        found.setdefault((str(agent), str(kind)), []).append(rows)
    return found


def mean_curve(curves: Sequence[pd.DataFrame], by: str) -> tuple[Floats, Band] | None:
    """The mean learning curve of an agent over its seeds.

    Args:
        curves: those of its runs, from `curves_by_agent`.
        by: ``"step"``, ``"episode"`` or ``"seconds"``.

    Returns:
        The points, shape (n,), and the mean there with its interval; None without any run, or where
        one ended before the first point of another.
    """
    runs = [
        (rows[by].to_numpy(dtype=np.float64), rows["value"].to_numpy(dtype=np.float64))
        for rows in curves
    ]
    if not runs or max(points[0] for points, _ in runs) > min(points[-1] for points, _ in runs):
        return None
    grid = shared_grid([points for points, _ in runs], CURVE_POINTS)
    values = np.array([on_grid(points, returns, grid) for points, returns in runs])
    return grid, curve_band(values, seed=RESAMPLING_SEED)
