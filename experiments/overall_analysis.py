"""How agents compare over all environments of a study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from experiments.seed_values import RESAMPLING_SEED, values_over_seeds
from experiments.study_results import StudyResults
from mdp.array_types import Floats
from verdicts import (
    Band,
    Estimate,
    Summary,
    performance_profile,
    probability_of_improvement,
    summarise,
)


@dataclass(frozen=True)
class OverallAnalysis:
    """How the agents compare over all environments, by their scores.

    Attributes:
        scores: estimates by agent, the best first.
        improvement: by two agents' labels, the probability that the first scores higher.
        thresholds: scores at which the profiles are given, shape (n,).
        profiles: by agent, the share of runs that score higher than each of them.
    """

    scores: Mapping[str, Summary]
    improvement: Mapping[tuple[str, str], Estimate]
    thresholds: Floats
    profiles: Mapping[str, Band]


def analyse_overall(results: StudyResults) -> OverallAnalysis | None:
    """Judge the agents over all environments; None for a single one, or without scores."""
    study = results.study
    labels = [environment.label for environment in study.environments]
    if len(labels) < 2:
        return None
    columns = [values_over_seeds(results, label, "score") for label in labels]
    scores = {
        agent.label: np.column_stack([column[agent.label] for column in columns])
        for agent in study.agents
    }
    if any(np.isnan(matrix).all(axis=0).any() for matrix in scores.values()):
        return None
    summaries = {agent: summarise(matrix, seed=RESAMPLING_SEED) for agent, matrix in scores.items()}
    order = sorted(summaries, key=lambda agent: summaries[agent].iqm.point, reverse=True)
    thresholds = np.linspace(0, 1, 101)
    return OverallAnalysis(
        scores={agent: summaries[agent] for agent in order},
        improvement=_improvement({agent: scores[agent] for agent in order}),
        thresholds=thresholds,
        profiles={
            agent: performance_profile(scores[agent], thresholds, seed=RESAMPLING_SEED)
            for agent in order
        },
    )


def _improvement(scores: Mapping[str, Floats]) -> dict[tuple[str, str], Estimate]:
    """How probable it is that one agent scores higher than another, seen from both sides."""
    found = {}
    for one, two in combinations(scores, 2):
        chance = probability_of_improvement(scores[one], scores[two], seed=RESAMPLING_SEED)
        found[one, two] = chance
        found[two, one] = replace(
            chance, point=1 - chance.point, low=1 - chance.high, high=1 - chance.low
        )
    return found
