"""What Thompson sampling believes of its arms, as densities to draw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from experiments.pull_statistics import PullStatistics
from experiments.study_results import StudyResults

N_POINTS = 241

Floats = NDArray[np.float64]


def is_normal(results: StudyResults, agent: str) -> bool:
    """Whether the agent takes rewards to have normal noise, so that its beliefs are normal too."""
    spec = next(planned.spec for planned in results.planned if planned.agent == agent)
    return spec.hyperparams.algorithm.get("likelihood") == "gaussian"


def grid(true_means: Floats, *, is_normal: bool) -> Floats:
    """Mean rewards to give densities at, shape (n_points,)."""
    if is_normal:
        return np.linspace(true_means.min() - 2, true_means.max() + 2, N_POINTS)
    return np.linspace(0.0, min(2 * float(true_means.max()), 1.0), N_POINTS)


def density(parameters: Floats, points: Floats, *, is_normal: bool) -> Floats:
    """The density of a belief.

    Args:
        parameters: mean and standard deviation of a normal distribution, or the two parameters of a
            Beta distribution.
        points: where.
        is_normal: which of them.
    """
    family = stats.norm if is_normal else stats.beta
    return np.asarray(family.pdf(points, *parameters))


def truth(statistics: PullStatistics, context: int, arm: int) -> float | None:
    """The mean of the arm that a belief is about; None for an agent that knows no contexts."""
    if statistics.posteriors.shape[1] != len(statistics.true_means):
        return None
    return float(statistics.true_means[context, arm])
