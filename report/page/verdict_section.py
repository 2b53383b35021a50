"""What the study has shown, in words."""

from __future__ import annotations

from typing import Any

from experiments.study_spec import COSTS, METRIC_WORDS
from report.conclusions import conclusion, places_without_a_run
from report.latex import LATEX
from report.markdown import MARKDOWN
from report.page.sections import Report, Section
from report.series.run_series import Grid, best_of
from report.series.study_series import EnvironmentSeries
from report.verdict_matrix import PHRASES, SIGNS, says_more, verdict_matrix
from report.verdict_table import verdicts_as


def section(report: Report) -> Section | None:
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
    files = {
        name: verdicts_as(markup, report.analysis, report.command)
        for name, markup in (("md", MARKDOWN), ("tex", LATEX))
    }
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
