"""Sections on results: overview, verdicts, rankings, curves, differences, scores, settings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rl_yardstick.experiments.plan import tuning_seeds
from rl_yardstick.experiments.pool import ERROR_FILE
from rl_yardstick.experiments.results import StudyResults, mixed_versions
from rl_yardstick.experiments.study import COSTS, METRIC_WORDS, StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.files import read_text
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.report import words
from rl_yardstick.report.documents import MARKUPS, verdicts_as
from rl_yardstick.report.page.frame import Report, Section, setting
from rl_yardstick.report.ranking import COLUMNS, OTHER_RETURNS, Column, Row, filled
from rl_yardstick.report.series import (
    AgentRuns,
    Curve,
    EnvironmentSeries,
    linear_up_to,
    mean_regret,
    with_best_mean,
)
from rl_yardstick.report.words import number, seed_sentence

WIDTH, HEIGHT = 200, 100  # of a small figure, in the drawing's own unit


def overview(report: Report) -> Section | None:
    """All environments side by side, each as a small figure; None for a single one."""
    environments = report.series.environments
    if len(environments) < 2:
        return None
    figures = [_small_figure(one) for one in environments]
    agents = [label for label in report.series.marks if any(label in f["lines"] for f in figures)]
    context = {"figures": figures, "agents": agents, "width": WIDTH, "height": HEIGHT}
    return Section("overview", "Environments", context, data={})


def _small_figure(one: EnvironmentSeries) -> dict[str, Any]:
    """By agent the points of an SVG polyline, and the distance of the optimum from the top."""
    curves: Mapping[str, Curve] = {}
    linear, optimum = None, None
    if one.pulls is not None:
        what = "cumulative regret by pull"
        curves = {agent: mean_regret(found) for agent, found in one.pulls.pulls.items()}
    else:
        what, optimum = "return of evaluations", one.environment.optimum
        if one.curves is not None:
            found = one.curves["evaluation"]
            what += f" by {found.budget}"
            curves, linear = found.by_axis[found.budget], found.linear_up_to
    heights = {agent: _compressed(curve.y, linear) for agent, curve in curves.items()}
    best = _compressed(np.array([] if optimum is None else [optimum]), linear)
    known = np.concatenate([best, *heights.values()])
    known = known[np.isfinite(known)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    last = max((float(curve.x[-1]) for curve in curves.values()), default=1.0) or 1.0

    def down(height: float) -> float:
        # The distance from the top, with a margin for the width of a line.
        return 4 + (HEIGHT - 8) * (high - height) / ((high - low) or 1.0)

    lines = {}
    for agent, curve in curves.items():
        known_points = zip(WIDTH * curve.x / last, heights[agent], strict=True)
        points = [f"{x:.1f},{down(y):.1f}" for x, y in known_points if math.isfinite(y)]
        lines[agent] = " ".join(points)
    optimum = down(float(best[0])) if best.size else None
    return {"name": one.environment.environment, "what": what, "lines": lines, "optimum": optimum}


def _compressed(values: Floats, linear: float | None) -> Floats:
    """Heights on an axis that is logarithmic beyond ``linear``, as in the large figure."""
    if linear is None:
        return values
    size = np.maximum(np.abs(values) / linear, 1e-300)
    return np.asarray(np.sign(values) * np.where(size <= 1, size, 1 + np.log10(size)))


def verdict(report: Report) -> Section | None:
    """For each environment the lead, the pairs as a matrix or sentences, and the notes."""
    analysis, environments = report.analysis, report.series.environments
    study, metric = analysis.study, METRIC_WORDS[analysis.study.metric]
    cards = [
        {
            "environment": one.environment,
            "conclusion": words.conclusion(study, one.environment),
            "pairs": words.pairs_both_ways(one.environment.pairs),
            "has_sweeps": bool(one.sweeps),
            "grids": {
                name: {
                    "grid": grid,
                    "best": with_best_mean(one.environment, *grid.labels),
                    "shares": grid.shares(is_cost=study.metric in COSTS),
                }
                for name, grid in one.grids.items()
            },
        }
        for one in environments
    ]
    context = {
        "general": [*words.overall_sentences(analysis), *words.places_without_a_run(analysis)],
        "cards": cards,
        "unseen": words.unseen_sentence(analysis),
        "metric": metric,
    }
    files = {name: verdicts_as(name, analysis, report.command) for name in MARKUPS}
    data = {"files": files, "metric": metric, "sweeps": [_sweeps(one) for one in environments]}
    return Section("verdict", "Verdict", context, data)


def _sweeps(one: EnvironmentSeries) -> dict[str, dict[str, Any]]:
    """By sweep, the means by parameter, and which of them are the best of all sweeps."""
    best = with_best_mean(one.environment, *(sweep.labels for sweep in one.sweeps.values()))
    found = {}
    for group, sweep in one.sweeps.items():
        marks = [label in best for label in sweep.labels]
        found[group] = {**vars(sweep.means), "parameter": sweep.parameter, "best": marks}
    return found


def ranking(report: Report) -> Section | None:
    """For each environment the ranking, other returns, and a sentence on changed training."""
    study, tables = report.analysis.study, []
    for environment in report.analysis.environments:
        rows = [Row(agent, environment) for agent in environment.agents]
        has_others = any(agent.stochastic or agent.discounted for agent in environment.agents)
        table = {
            **_table(study, [column for column in COLUMNS if column.page], rows),
            "others": _table(study, OTHER_RETURNS, rows) if has_others else None,
            "changes": words.on_changes([environment]),
        }
        tables.append(table)
    context = {"tables": tables, "metric": METRIC_WORDS[study.metric]}
    return Section("ranking", "Ranking", context, by_environment=True)


def _table(study: StudySpec, columns: Sequence[Column], rows: Sequence[Row]) -> dict[str, Any]:
    """The columns, the words in their headings, and each agent's cells."""
    shown, of = filled(columns, rows), rows[0].environment
    return {
        "columns": [column for column, _ in shown],
        "orders": [column.order(study) for column, _ in shown],
        "words": {"threshold": number(of.threshold), "failed": number(of.failure_threshold)},
        "rows": [(row.agent, [cells[k] for _, cells in shown]) for k, row in enumerate(rows)],
    }


STAGES = (0.1, 0.25, 0.5, 1.0)  # shares of an agent's training with a column in the table


def curves(report: Report) -> Section | None:
    """The curves of every environment, kind and axis; the script chooses among them.

    Bandits have a section of their own, with curves by pull.
    """
    curves = [one.curves for one in report.series.environments]
    if not (len(report.analysis.results.curves) and any(curves)):
        return None
    # For readers who cannot see the figure: the evaluations as a table.
    shown = [None if item is None else item["evaluation"] for item in curves]
    context = {
        "stages": STAGES,
        "units": ["step" if found is None else found.budget for found in shown],
        "tables": [
            [
                (agent, [_at(curve, share) for share in STAGES])
                for agent, curve in (found.by_axis[found.budget].items() if found else ())
            ]
            for found in shown
        ],
    }
    return Section("curves", "Learning curves", context, places=curves, by_environment=True)


def _at(curve: Curve, share: float) -> dict[str, float]:
    """The point of a curve nearest to this share of its range of x."""
    nearest = np.abs(curve.x - share * curve.x[-1]).argmin()
    return {name: values[nearest] for name, values in vars(curve).items()}


# With more runs of an agent than this, the page shows only their mean.
MOST_DOTS = 300


def comparison(report: Report) -> Section | None:
    """Intervals and each run as figures, the pairs as a table and as a matrix."""
    study = report.analysis.study
    metric, is_cost = METRIC_WORDS[study.metric], study.metric in COSTS
    context = {"metric": metric, "most_dots": MOST_DOTS, "lower_is_better": is_cost}
    places = [
        {
            "intervals": [_runs(agent) for agent in one.runs],
            "words": {f"{p.first} | {p.second}": p.text for p in one.environment.pairs},
            "linear": linear_up_to((runs.values for runs in one.runs), one.environment.optimum),
        }
        for one in report.series.environments
    ]
    data = {"metric": metric}
    return Section("comparison", "Differences", context, data, places, by_environment=True)


def _runs(agent: AgentRuns) -> dict[str, Any]:
    """The mean, and each run unless there are too many to see."""
    shown = slice(0 if len(agent.values) > MOST_DOTS else None)
    runs = {"seeds": agent.seeds[shown], "runs": agent.values[shown]}
    return {"agent": agent.agent, **vars(agent.mean), **runs}


def overall(report: Report) -> Section | None:
    """Aggregates, profiles and the score on each environment; None for a single environment."""
    overall = report.analysis.overall
    if overall is None:
        return None
    agents = list(overall.scores)
    scores = [
        {agent.agent: agent.score for agent in one.agents if agent.score is not None}
        for one in report.analysis.environments
    ]
    context = {
        "agents": agents,
        "scores": scores,
        "pairs": words.pairs_both_ways(overall.pairs),
        "unproven": words.unproven_sentences(report.analysis.environments),
    }
    data = {
        "agents": agents,
        "means": [{"agent": agent, **vars(overall.scores[agent].mean)} for agent in agents],
        "thresholds": overall.thresholds,
        "profiles": overall.profiles,
    }
    return Section("overall", "Overall", context, data)


def watching(report: Report) -> Section | None:
    """The links to pages that play trainings; None where none were asked for."""
    if not report.learning:
        return None
    return Section("watching", "See it learn", {"pages": report.learning}, by_environment=True)


ABSENT = "-"


def settings(report: Report) -> Section | None:
    """What a reader needs to repeat the study: settings, command, seeds, versions, failures."""
    results, environments = report.analysis.results, report.analysis.environments
    runs: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run in results.finished:
        runs.setdefault(run.labels, []).append(run.recorded())
    infos = [info for of_agent in runs.values() for info in of_agent]
    context = {
        "command": report.command,
        "seeds": seed_sentence(results.study.seeds, tuning_seeds(results.study)),
        "absent": ABSENT,
        "tables": [
            _settings_table({a: found for (a, on), found in runs.items() if on == one.environment})
            for one in environments
        ],
        "versions": recorded("versions", infos),
        "machine": recorded("machine", infos),
        "mixed": mixed_versions(infos),
        "notes": [  # of a run on each: the numbers in them are others in every run
            f"{on}: {note}"
            for on, info in {on: found[0] for (_, on), found in runs.items()}.items()
            for note in info.get("notes", ())
        ],
        "missing": _missing_runs(results),
    }
    return Section("settings", "Settings", context, by_environment=True)


def _settings_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """The agents, and for each setting its values by agent and whether these differ."""
    columns = {agent: _column(infos) for agent, infos in runs.items()}
    rows = {}
    for name in dict.fromkeys(name for column in columns.values() for name in column):
        values = [column.get(name, ABSENT) for column in columns.values()]
        rows[name] = (values, len({*values} - {ABSENT}) > 1)
    return {"agents": list(columns), "rows": rows}


def _column(infos: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The settings of an agent, which its seeds share, and how long its runs were."""
    spec = TrainSpec.model_validate(infos[0]["spec"])
    steps = sorted(info["n_timesteps"] for info in infos)
    lengths = f"{steps[0]:,}" if steps[0] == steps[-1] else f"{steps[0]:,} to {steps[-1]:,}"
    column = {"agent": spec.algo, "steps run": lengths}
    if engines := sorted({str(info["engine"]) for info in infos if info.get("engine")}):
        column["engine"] = "; ".join(engines)
    return column | {name: setting(value) for name, value in spec.hyperparams.items()}


def recorded(what: str, infos: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Versions or parts of the machine by name, all distinct values joined."""
    table = pd.DataFrame([info[what] for info in infos])
    return {str(name): ", ".join(sorted(table[name].dropna().unique())) for name in table}


def _missing_runs(results: StudyResults) -> list[dict[str, Any]]:
    """Missing runs, grouped by agent, environment and reason: an error's last line."""
    groups: dict[tuple[str, str, str], dict[str, Any]] = {}
    unreadable = {one.planned.path: one.reason for one in results.left_out}
    there = {run.path for run in results.finished}
    for run in results.planned:
        if run.path in there:
            continue
        details, error = results.failures.get(run.path, ""), run.path / ERROR_FILE
        details = (read_text(error) if details and error.exists() else details).strip()
        reason = unreadable.get(run.path) or details.rpartition("\n")[2] or "not done yet"
        new = {"agent": run.agent, "environment": run.environment, "reason": reason, "seeds": []}
        group = groups.setdefault((run.agent, run.environment, reason), new)
        group["seeds"].append(run.seed)
        group["details"] = details
    return list(groups.values())
