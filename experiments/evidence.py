"""What the verdicts on an environment rest on: scores over seeds, and what they are held to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.reliability import agents_without_chance
from experiments.seed_values import values_over_seeds
from experiments.study_results import StudyResults
from experiments.study_spec import COSTS
from mdp.array_types import Floats
from verdicts import FEWEST_SEEDS, fewest_seeds

MARGIN = 0.02  # of the way from the best random or constant policy to the optimum


@dataclass(frozen=True)
class Evidence:
    """What verdicts on an environment rest on.

    Attributes:
        environment: its label.
        scores: by agent, the higher the better, shape (n_seeds,): NaN where there is no run.
        seeds: by agent, how many of the seeds it was to have.
        optimum: the highest expected return that any policy has, or of a bracket what none
            exceeds; or None.
        optimum_at_least: the lower end of that bracket; None where there is none.
        baseline: that of the best random or constant policy, or None.
        threshold: the return that counts as solved, or None.
        margin: the difference within which agents count as equivalent.
        certain: the agents that do not depend on chance.
    """

    environment: str
    scores: Mapping[str, Floats]
    seeds: Mapping[str, int]
    optimum: float | None
    optimum_at_least: float | None
    baseline: float | None
    threshold: float | None
    margin: float
    certain: frozenset[str]

    @property
    def given(self) -> dict[str, Floats]:
        """The scores by agent, as many as it has seeds."""
        return {name: values[: self.seeds[name]] for name, values in self.scores.items()}

    def fewest(self, level: float) -> int:
        """With how few seeds any two agents can be told apart at this level."""
        there = {name for name, values in self.scores.items() if np.isfinite(values).any()}
        n_tested = math.comb(len(there), 2) - math.comb(len(there & self.certain), 2)
        return max(fewest_seeds(level / max(n_tested, 1)), FEWEST_SEEDS)


def evidence_on(results: StudyResults, environment: str) -> Evidence | None:
    """What there is on an environment; None where no run has finished."""
    study, table = results.study, results.summary
    table = table[table["environment"] == environment]
    if table.empty:
        return None
    sign = -1.0 if study.metric in COSTS else 1.0
    values = values_over_seeds(results, environment, study.metric)
    optimum, baseline = _first(table, "optimum"), _first(table, "baseline")
    at_least = _first(table, "optimum_at_least")
    reachable = optimum if at_least is None else at_least
    span = 0.0 if reachable is None or baseline is None else reachable - baseline
    return Evidence(
        environment=environment,
        scores={name: sign * each for name, each in values.items()},
        seeds=_seeds(results, environment),
        optimum=optimum,
        optimum_at_least=at_least,
        baseline=baseline,
        threshold=_first(table, "threshold"),
        margin=MARGIN * span if study.margin is None else study.margin,
        certain=agents_without_chance(results, table),
    )


def _seeds(results: StudyResults, environment: str) -> dict[str, int]:
    counts = dict.fromkeys((agent.label for agent in results.study.agents), 0)
    for run in results.planned:
        if run.environment == environment:
            counts[run.agent] += run.n_runs
    return counts


def _first(table: pd.DataFrame, column: str) -> float | None:
    known = table[column].dropna()
    return None if known.empty else float(known.iloc[0])
