"""What Thompson sampling believes of its arms, as densities to draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from experiments.bandits import PullStatistics
from experiments.results import StudyResults
from mdp.array_types import Floats, Ints

N_POINTS = 241


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


@dataclass(frozen=True)
class Belief:
    """What an agent believed of the arms in its first run.

    Attributes:
        agent: its label.
        moments: after how many pulls, shape (n_moments,).
        points: mean rewards that the densities are given at, shape (n_points,).
        densities: shape (n_moments, n_contexts, n_arms, n_points).
        true_means: by context and arm; None for an agent that knows no contexts.
    """

    agent: str
    moments: Ints
    points: Floats
    densities: Floats
    true_means: list[list[float | None]]


def belief(results: StudyResults, agent: str, statistics: PullStatistics) -> Belief:
    """The densities of an agent's beliefs, at all moments that were kept."""
    normal = is_normal(results, agent)
    points = grid(statistics.true_means, is_normal=normal)
    parameters = statistics.posteriors
    _, n_contexts, n_arms, _ = parameters.shape
    densities = [density(row, points, is_normal=normal) for row in parameters.reshape(-1, 2)]
    return Belief(
        agent,
        statistics.moments,
        points,
        np.reshape(densities, (*parameters.shape[:3], len(points))),
        [[truth(statistics, c, arm) for arm in range(n_arms)] for c in range(n_contexts)],
    )
