"""What each run has come to, and the means with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.analysis import EnvironmentAnalysis
from experiments.seed_values import values_over_seeds
from experiments.study_results import StudyResults
from experiments.study_spec import AgentSpec
from mdp.array_types import Floats, Ints
from report.series.axis_scale import linear_up_to
from report.series.curve_series import Curve
from verdicts import Estimate

LEAST_VALUES = 3  # of a parameter, for a figure of it


@dataclass(frozen=True)
class AgentRuns:
    """The runs of an agent that have a figure.

    Attributes:
        agent: its label.
        mean: their mean with its interval.
        seeds: which runs, shape (n_runs,).
        values: what they have come to, likewise.
    """

    agent: str
    mean: Estimate
    seeds: Ints
    values: Floats


@dataclass(frozen=True)
class RunSeries:
    """The runs of all agents on an environment.

    Attributes:
        agents: the best first.
        linear_up_to: as in `LearningCurves`.
    """

    agents: tuple[AgentRuns, ...]
    linear_up_to: float | None


def run_series(results: StudyResults, environment: EnvironmentAnalysis) -> RunSeries:
    """The runs on an environment, by what the verdicts are about."""
    values = values_over_seeds(results, environment.environment, results.study.metric)
    agents = []
    for agent in environment.agents:
        there = np.flatnonzero(np.isfinite(values[agent.agent]))
        runs, seeds = values[agent.agent][there], there + results.study.first_seed
        agents.append(AgentRuns(agent.agent, agent.metric.mean, seeds, runs))
    scale = linear_up_to((runs.values for runs in agents), environment.optimum)
    return RunSeries(tuple(agents), scale)


def sweeps(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Curve]:
    """What the verdicts are about against the one parameter that agents were swept over.

    Args:
        agents: those of the study.
        environment: where.

    Returns:
        By agent and parameter, the means in the order of the parameter's values.
    """
    means = {agent.agent: agent.metric.mean for agent in environment.agents}
    groups: dict[str, list[tuple[float, Estimate]]] = {}
    for spec in agents:
        swept = list(spec.swept.items())
        if spec.label in means and len(swept) == 1 and isinstance(swept[0][1], int | float):
            ((parameter, value),) = swept
            group = groups.setdefault(f"{spec.group}: {parameter}", [])
            group.append((float(value), means[spec.label]))
    return {name: _by_value(rows) for name, rows in groups.items() if len(rows) >= LEAST_VALUES}


def _by_value(rows: list[tuple[float, Estimate]]) -> Curve:
    rows = sorted(rows, key=lambda row: row[0])
    columns = zip(*((value, e.point, e.low, e.high) for value, e in rows), strict=True)
    return Curve(*map(np.array, columns))
