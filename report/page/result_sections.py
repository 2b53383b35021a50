"""Sections on results: overview, verdicts, rankings, curves, differences, scores."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.analysis import EnvironmentAnalysis, OverallAnalysis, StudyAnalysis
from experiments.study import COSTS, METRIC_WORDS, StudySpec
from mdp.array_types import Floats
from report.conclusions import conclusion, on_changes, places_without_a_run
from report.documents import MARKUPS, verdicts_as
from report.page.frame import Report, Section, estimate_data
from report.ranking import COLUMNS, Row, filled
from report.series import (
    AgentRuns,
    Curve,
    EnvironmentSeries,
    Grid,
    LearningCurves,
    PullSeries,
    best_of,
    mean_regret,
)
from report.terminal import PHRASES, SIGNS, says_more, verdict_matrix
from report.words import number
from verdicts import Estimate

# All environments side by side, each as a small figure.

WIDTH, HEIGHT = 200, 100  # in the drawing's own unit


@dataclass(frozen=True)
class SmallFigure:
    """The curves of an environment."""

    name: str  # the environment's
    what: str  # what goes upwards
    lines: Mapping[str, str]  # by agent, corners of its line as SVG takes them
    # How far from the top the optimum lies; None where it is not known or not shown.
    optimum: float | None


def overview(report: Report) -> Section | None:
    """A figure for each environment; None for a single one."""
    environments = report.series.environments
    if len(environments) < 2:
        return None
    figures = [_figure(one) for one in environments]
    agents = [label for label in report.series.marks if any(label in f.lines for f in figures)]
    context = {"figures": figures, "agents": agents, "width": WIDTH, "height": HEIGHT}
    return Section("overview", "Environments", context, data={})


def _figure(one: EnvironmentSeries) -> SmallFigure:
    name = one.environment.environment
    if one.pulls is not None:
        return SmallFigure(name, "cumulative regret by pull", _regret(one.pulls), None)
    evaluations = None if one.curves is None else one.curves["evaluation"]
    curves = {} if evaluations is None else evaluations.by_axis["step"]
    linear = None if evaluations is None else evaluations.linear_up_to
    return _drawn(name, "return of evaluations by step", curves, one.environment.optimum, linear)


def _regret(pulls: PullSeries) -> dict[str, str]:
    curves = {agent: mean_regret(found) for agent, found in pulls.pulls.items()}
    return dict(_drawn("", "", curves, None, None).lines)


def _drawn(
    name: str,
    what: str,
    curves: Mapping[str, Curve],
    optimum: float | None,
    linear: float | None,
) -> SmallFigure:
    upright = {agent: _compressed(curve.y, linear) for agent, curve in curves.items()}
    best = None if optimum is None else float(_compressed(np.array([optimum]), linear)[0])
    known = [*upright.values(), *([] if best is None else [np.array([best])])]
    low, high = _range(known)
    last = max((float(curve.x[-1]) for curve in curves.values()), default=1.0) or 1.0
    lines = {
        agent: " ".join(
            f"{WIDTH * x / last:.1f},{_down(y, low, high):.1f}"
            for x, y in zip(curves[agent].x, values, strict=True)
            if math.isfinite(y)
        )
        for agent, values in upright.items()
    }
    return SmallFigure(name, what, lines, None if best is None else _down(best, low, high))


def _compressed(values: Floats, linear: float | None) -> Floats:
    """Heights on an axis that is logarithmic beyond ``linear``, as the large figure has it."""
    if linear is None:
        return values
    size = np.maximum(np.abs(values) / linear, 1e-300)
    return np.asarray(np.sign(values) * np.where(size <= 1, size, 1 + np.log10(size)))


def _range(values: Iterable[Floats]) -> tuple[float, float]:
    known = np.concatenate([[], *values])
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)


def _down(value: float, low: float, high: float) -> float:
    """How far below the top, with room for the width of a line."""
    return 4 + (HEIGHT - 8) * (high - value) / ((high - low) or 1.0)


# What the study has shown: verdicts, rankings, curves, differences, scores.


def verdict(report: Report) -> Section | None:
    """For each environment a line, the pairs as a matrix, and folded the rest."""
    study = report.analysis.study
    cards = [
        {
            "environment": one.environment,
            "conclusion": conclusion(study, one.environment),
            "matrix": verdict_matrix(one.environment) if says_more(one.environment) else None,
            "has_sweeps": bool(one.sweeps),
            "grids": {name: _grid(one, grid, study.metric) for name, grid in one.grids.items()},
        }
        for one in report.series.environments
    ]
    context = {
        "general": places_without_a_run(report.analysis),
        "cards": cards,
        "signs": SIGNS,
        "phrases": PHRASES,
        "metric": METRIC_WORDS[study.metric],
    }
    files = {name: verdicts_as(name, report.analysis, report.command) for name in MARKUPS}
    sweeps = [_sweeps(one) for one in report.series.environments]
    data = {"files": files, "metric": METRIC_WORDS[study.metric], "sweeps": sweeps}
    return Section("verdict", "Verdict", context, data)


def _sweeps(one: EnvironmentSeries) -> dict[str, dict[str, Any]]:
    """By agent, what its figure shows: means by parameter, and which are the best of all."""
    best = best_of(one.environment, [at for sweep in one.sweeps.values() for at in sweep.labels])
    return {
        group: {
            **vars(sweep.means),
            "parameter": sweep.parameter,
            "best": [label in best for label in sweep.labels],
        }
        for group, sweep in one.sweeps.items()
    }


def _grid(one: EnvironmentSeries, grid: Grid, metric: str) -> dict[str, Any]:
    """The heat map of an agent: its rows of cells."""
    best = best_of(one.environment, [label for row in grid.labels for label in row])
    shares = grid.shares(is_cost=metric in COSTS)
    rows = [
        [
            {"mean": mean, "strength": f"{90 * share:.0f}%", "is_best": label in best}
            for label, mean, share in zip(labels, means, of_row, strict=True)
        ]
        for labels, means, of_row in zip(grid.labels, grid.means, shares, strict=True)
    ]
    return {"grid": grid, "n_best": len(best), "rows": list(zip(grid.down, rows, strict=True))}


def ranking(report: Report) -> Section | None:
    """A table for each environment."""
    study = report.analysis.study
    context = {
        "tables": [_ranking(study, environment) for environment in report.analysis.environments],
        "metric": METRIC_WORDS[study.metric],
    }
    return Section("ranking", "Ranking", context, by_environment=True)


def _ranking(study: StudySpec, environment: EnvironmentAnalysis) -> dict[str, Any]:
    """Headings, and by agent the cells below them."""
    rows = [Row(agent, environment) for agent in environment.agents]
    columns = filled([column for column in COLUMNS if column.page], rows)
    threshold = number(environment.threshold)
    return {
        "headings": [
            {
                "title": column.page,
                "help": column.help.format(threshold=threshold),
                "order": column.order(study),
            }
            for column, _ in columns
        ],
        "rows": [
            (row.agent, [cells[place] for _, cells in columns]) for place, row in enumerate(rows)
        ],
        "changes": on_changes([environment]),
    }


STAGES = (0.1, 0.25, 0.5, 1.0)  # shares of an agent's training that the table has a column for


def curves(report: Report) -> Section | None:
    """The curves of every environment, kind and axis, as the script chooses among them.

    Bandits have theirs by pull, in a section of their own.
    """
    curves = [one.curves for one in report.series.environments]
    if report.analysis.results.curves.empty or not any(curves):
        return None
    context = {
        "has_curves": [item is not None for item in curves],
        "stages": STAGES,
        "tables": [[] if item is None else _stages(item["evaluation"]) for item in curves],
    }
    data = [None if item is None else _environment_data(item) for item in curves]
    return Section("curves", "Learning curves", context, places=data, by_environment=True)


def _environment_data(curves: Mapping[str, LearningCurves]) -> dict[str, Any]:
    return {
        kind: {
            "linearUpTo": of_kind.linear_up_to,
            "onVariant": of_kind.on_variant,
            **{
                by: {agent: vars(curve) for agent, curve in of_agents.items()}
                for by, of_agents in of_kind.by_axis.items()
            },
        }
        for kind, of_kind in curves.items()
    }


def _stages(evaluations: LearningCurves) -> list[tuple[str, list[dict[str, float]]]]:
    """What an agent's curve comes to by each stage: for those who cannot see the figure."""
    curves = evaluations.by_axis["step"]
    return [(agent, [_at(curve, share) for share in STAGES]) for agent, curve in curves.items()]


def _at(curve: Curve, share: float) -> dict[str, float]:
    """The point of a curve that lies nearest to a share of its way."""
    nearest = np.abs(curve.x - share * curve.x[-1]).argmin()
    return {name: values[nearest] for name, values in vars(curve).items()}


# A page with more runs than this of each agent shows their means alone.
MOST_DOTS = 300


def comparison(report: Report) -> Section | None:
    """Intervals and each run as figures, the pairs as a table and as a matrix."""
    analysis = report.analysis
    metric = METRIC_WORDS[analysis.study.metric]
    context = {
        "metric": metric,
        "phrases": PHRASES,
        "most_dots": MOST_DOTS,
        "lower_is_better": analysis.study.metric in COSTS,
        "matrices": [improvement_matrix(one) for one in analysis.environments],
    }
    places = [_intervals(one) for one in report.series.environments]
    return Section(
        "comparison", "Differences", context, {"metric": metric}, places, by_environment=True
    )


def _intervals(one: EnvironmentSeries) -> dict[str, Any]:
    return {
        "intervals": [_runs(agent) for agent in one.runs.agents],
        "linearUpTo": one.runs.linear_up_to,
    }


def _runs(agent: AgentRuns) -> dict[str, Any]:
    """The mean, and each run where they are not too many to be told apart."""
    many = len(agent.values) > MOST_DOTS
    return {
        "agent": agent.agent,
        **estimate_data(agent.mean),
        "seeds": agent.seeds[:0] if many else agent.seeds,
        "runs": agent.values[:0] if many else agent.values,
    }


def improvement_matrix(environment: EnvironmentAnalysis) -> list[list[float | None]]:
    """The probability that a run of the row's agent beats one of the column's, None on itself."""
    chances: dict[tuple[str, str], float] = {}
    for pair in environment.pairs:
        for seen in (pair, pair.swapped()):
            chances[seen.first, seen.second] = seen.probability_of_improvement.point
    agents = [agent.agent for agent in environment.agents]
    return [[chances.get((row, column)) for column in agents] for row in agents]


def overall(report: Report) -> Section | None:
    """Aggregates, profiles and the score on each environment; None for a single environment."""
    overall = report.analysis.overall
    if overall is None:
        return None
    agents = list(overall.scores)
    context = {
        "agents": agents,
        "scores": _scores(report.analysis, agents),
        "improvement": [
            [overall.improvement[one, two].point if one != two else None for two in agents]
            for one in agents
        ],
    }
    return Section("overall", "Overall", context, _profiles(overall))


def _profiles(overall: OverallAnalysis) -> dict[str, Any]:
    agents = list(overall.scores)
    return {
        "agents": agents,
        "iqm": [{"agent": agent, **estimate_data(overall.scores[agent].iqm)} for agent in agents],
        "thresholds": overall.thresholds,
        "profiles": {
            agent: {"y": band.point, "low": band.low, "high": band.high}
            for agent, band in overall.profiles.items()
        },
    }


def _scores(analysis: StudyAnalysis, agents: list[str]) -> list[dict[str, Estimate]]:
    """The mean score by agent, for each environment."""
    return [
        {
            agent.agent: agent.score.mean
            for agent in environment.agents
            if agent.score is not None and agent.agent in agents
        }
        for environment in analysis.environments
    ]


def watching(report: Report) -> Section | None:
    """The links, by environment; None where no pages were asked for."""
    if not report.learning:
        return None
    groups = [
        [page for page in report.learning if page.environment == environment.environment]
        for environment in report.analysis.environments
    ]
    return Section("watching", "See it learn", {"groups": groups}, by_environment=True)
