"""What an environment's runs say beside their typical score: who failed, and who arrived when."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd

from agents import ALGORITHMS
from experiments.seed_values import values_over_seeds
from experiments.study_results import StudyResults
from mdp.array_types import Floats
from verdicts import (
    FailureCount,
    SpeedComparison,
    compare_speed,
    count_failures,
    failure_threshold,
)

# Of the metrics, those on the scale of the best random or constant policy.
ON_THE_SCALE = ("final", "best")

# Where the agents live whose policies do not depend on what they go through.
FIXED_POLICIES = ("agents.planning:", "agents.reference:")


def agents_without_chance(results: StudyResults, table: pd.DataFrame) -> frozenset[str]:
    """The agents that do not learn, where policies are evaluated exactly: every run is the same."""
    if not (table["exact"] == True).all():  # noqa: E712  # None is no False here
        return frozenset()
    return frozenset(
        agent.label
        for agent in results.study.agents
        if agent.algo in ALGORITHMS
        and ALGORITHMS[agent.algo].entry_point.startswith(FIXED_POLICIES)
    )


def failures(
    metric: str,
    scores: Mapping[str, Floats],
    baseline: float | None,
    level: float,
    certain: Collection[str],
) -> dict[str, FailureCount]:
    """By agent that depends on chance, the runs that get less than half as far as the best do.

    Both counted from the baseline. The bounds of all agents hold together. Nothing where the
    baseline is not known.
    """
    by_chance = {name: values for name, values in scores.items() if name not in certain}
    if metric not in ON_THE_SCALE or baseline is None or not by_chance:
        return {}
    known = [values[np.isfinite(values)] for values in scores.values()]
    typical = max((float(np.median(values)) for values in known if len(values)), default=np.nan)
    threshold = failure_threshold(baseline, typical)
    if np.isnan(threshold):
        return {}
    return {
        name: count_failures(values, threshold, level / len(by_chance))
        for name, values in by_chance.items()
    }


def speeds(
    results: StudyResults, environment: str, agents: Sequence[str], level: float
) -> tuple[SpeedComparison, ...]:
    """Which agents come to stay above the threshold sooner than others."""
    curves = results.curves
    chosen = (curves["environment"] == environment) & (curves["kind"] == "evaluation")
    spans = [
        np.diff(rows["step"].to_numpy(dtype=np.float64), prepend=0.0).max()
        for _, rows in curves[chosen & curves["agent"].isin(agents)].groupby(["agent", "seed"])
    ]
    spacing = max(spans, default=0.0)
    if not spacing > 0:
        return ()
    steps = values_over_seeds(results, environment, "steps_to_stay")
    return tuple(compare_speed({name: steps[name] for name in agents}, spacing, level))
