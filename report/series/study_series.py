"""All numbers that the figures of a study show: drawn on paper and on the page from the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from pipeline.signs_of_life import Tell, tell_nobody
from report.series.agent_marks import Mark, agent_marks
from report.series.curve_series import LearningCurves, learning_curves
from report.series.pull_series import PullSeries, pull_series
from report.series.run_series import Grid, RunSeries, Sweep, grids, run_series, sweeps


@dataclass(frozen=True)
class EnvironmentSeries:
    """What there is to draw of an environment.

    Attributes:
        environment: how the agents did on it.
        curves: by kind; on bandits None, which have theirs by pull.
        runs: each run, and the means.
        pulls: on bandits; else None.
        sweeps: by agent, where it was swept over one parameter.
        grids: by agent, where it was swept over two.
    """

    environment: EnvironmentAnalysis
    curves: Mapping[str, LearningCurves] | None
    runs: RunSeries
    pulls: PullSeries | None
    sweeps: Mapping[str, Sweep]
    grids: Mapping[str, Grid] = field(default_factory=dict)


@dataclass(frozen=True)
class StudySeries:
    """What there is to draw of a study.

    Attributes:
        analysis: the study.
        marks: how each agent is drawn.
        environments: by environment.
    """

    analysis: StudyAnalysis
    marks: Mapping[str, Mark]
    environments: tuple[EnvironmentSeries, ...]


def study_series(analysis: StudyAnalysis, tell: Tell = tell_nobody) -> StudySeries:
    """Compute all that is drawn; most of the time goes into the intervals of the curves."""
    environments = []
    for one in analysis.environments:
        tell(one.environment)
        environments.append(_environment_series(analysis, one))
    return StudySeries(analysis, agent_marks(analysis.study), tuple(environments))


def _environment_series(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis
) -> EnvironmentSeries:
    results = analysis.results
    pulls = pull_series(results, environment)
    return EnvironmentSeries(
        environment=environment,
        curves=learning_curves(results, environment) if pulls is None else None,
        runs=run_series(results, environment),
        pulls=pulls,
        sweeps=sweeps(analysis.study.agents, environment),
        grids=grids(analysis.study.agents, environment),
    )
