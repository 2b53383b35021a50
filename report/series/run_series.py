"""What each run has come to, and the means with their intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.analysis import EnvironmentAnalysis
from experiments.results import StudyResults, values_over_seeds
from experiments.study import AgentSpec, symbol
from mdp.array_types import Floats, Ints
from report.series.curve_series import Curve, linear_up_to
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


@dataclass(frozen=True)
class Sweep:
    """Means by the one parameter that an agent was swept over.

    Attributes:
        parameter: what it is called on an axis.
        means: by its value, with their intervals.
        labels: of the agents in that order.
    """

    parameter: str
    means: Curve
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Grid:
    """Means by the two parameters that an agent was swept over.

    Attributes:
        parameters: what they are called on axes: the one that goes down and the one across.
        down, across: their values.
        means: shape (down, across), NaN where there is no run.
        labels: of the agents there; empty where there is none.
    """

    parameters: tuple[str, str]
    down: list[str]
    across: list[str]
    means: Floats
    labels: list[list[str]]

    def shares(self, *, is_cost: bool) -> Floats:
        """How far each mean is on the way from the worst to the best: 0 to 1."""
        known = self.means[np.isfinite(self.means)]
        low, high = known.min(initial=np.inf), known.max(initial=-np.inf)
        shares = (self.means - low) / (high - low if high > low else 1.0)
        return np.asarray(1 - shares if is_cost else shares)


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


def sweeps(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Sweep]:
    """By agent that was swept over one parameter, the means in the order of its values."""
    found: dict[str, Sweep] = {}
    means = _means(environment)
    for (group, name), members in _groups(agents, environment, 1).items():
        by_value = {
            float(one.swept[name]): one.label
            for one in members
            if isinstance(one.swept[name], int | float)
        }
        if len(by_value) >= LEAST_VALUES:
            x, labels = zip(*sorted(by_value.items()), strict=True)
            rows = [(e.point, e.low, e.high) for e in map(means.__getitem__, labels)]
            found[group] = Sweep(symbol(name), Curve(np.array(x), *np.array(rows).T), labels)
    return found


def grids(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Grid]:
    """By agent that was swept over two parameters, the means over the values of both."""
    found: dict[str, Grid] = {}
    means = _means(environment)
    for (group, *names), members in _groups(agents, environment, 2).items():
        down, across = ([str(one.swept[name]) for one in members] for name in names)
        rows, columns = list(dict.fromkeys(down)), list(dict.fromkeys(across))
        at = {
            (row, column): one.label for row, column, one in zip(down, across, members, strict=True)
        }
        labels = [[at.get((row, column), "") for column in columns] for row in rows]
        if len(rows) > 1 and len(columns) > 1:
            points = [[means[at].point if at else np.nan for at in row] for row in labels]
            parameters = symbol(names[0]), symbol(names[1])
            found[group] = Grid(parameters, rows, columns, np.array(points), labels)
    return found


def best_of(environment: EnvironmentAnalysis, labels: Sequence[str]) -> list[str]:
    """Those of these agents that have the best mean."""
    found = [agent for agent in environment.agents if agent.agent in labels]
    means = {agent.agent: agent.metric.mean.point for agent in found}
    return [
        label for label, mean in means.items() if math.isclose(mean, found[0].metric.mean.point)
    ]


def _means(environment: EnvironmentAnalysis) -> dict[str, Estimate]:
    return {agent.agent: agent.metric.mean for agent in environment.agents}


def _groups(
    agents: Sequence[AgentSpec], environment: EnvironmentAnalysis, n_parameters: int
) -> dict[tuple[str, ...], list[AgentSpec]]:
    """By label and parameters of each sweep over so many, its agents that have a mean there."""
    groups: dict[tuple[str, ...], list[AgentSpec]] = {}
    there = _means(environment)
    for spec in agents:
        if len(spec.swept) == n_parameters and spec.label in there:
            groups.setdefault((spec.group, *spec.swept), []).append(spec)
    return groups
