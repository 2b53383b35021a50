"""Sections on results: verdicts, rankings, curves, differences, scores, settings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rl_yardstick.experiments.analysis import EnvironmentAnalysis
from rl_yardstick.experiments.plan import tuning_seeds
from rl_yardstick.experiments.pool import ERROR_FILE
from rl_yardstick.experiments.results import StudyResults, mixed_versions
from rl_yardstick.experiments.study import COSTS, StudySpec
from rl_yardstick.pipeline.files import read_text
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.report import words
from rl_yardstick.report.documents import MARKUPS, headline, verdicts_as
from rl_yardstick.report.page.frame import Report, Section, setting
from rl_yardstick.report.ranking import COLUMNS, OTHER_RETURNS, Column, Order, Row, filled
from rl_yardstick.report.series import LINEAR, SCORES, STRETCHED, Curve, EnvironmentSeries
from rl_yardstick.report.words import number, seed_sentence, with_best_mean

MOST_DOTS = 300  # of an agent on an environment; of more runs as many, evenly spaced by rank


def verdict(report: Report) -> Section | None:
    """The answer, all runs as dots, the words by pair, and for each environment its sentences."""
    analysis, environments = report.analysis, report.series.environments
    study, metric = analysis.study, analysis.study.metric_words
    scores = [runs for one in analysis.environments if one.is_score for runs in one.scores.values()]
    n_high = sum(int((runs >= SCORES[1]).sum()) for runs in scores)
    is_stretched = 2 * n_high > sum(int(np.isfinite(runs).sum()) for runs in scores)
    cards: list[dict[str, Any]] = [
        {
            "environment": one.environment,
            "conclusion": words.conclusion(study, one.environment),
            "pairs": words.pairs_both_ways(one.environment.pairs),
            "dots": _dots(report, one.environment, is_stretched),
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
    tally: dict[tuple[str, str], Counter[str]] = {}
    for names, pair in (item for card in cards for item in card["pairs"].items()):
        tally.setdefault(names, Counter())[pair.text] += 1
    context = {
        "answer": [*words.answer(analysis), *words.places_without_a_run(analysis)],
        "tally": tally,
        "is_stretched": is_stretched,
        "most_dots": MOST_DOTS,
        "headline": headline(analysis),
        "cards": cards,
        "unseen": words.unseen_sentence(analysis),
        "metric": metric,
    }
    files = {name: verdicts_as(name, analysis, report.command) for name in MARKUPS}
    data = {"files": files, "metric": metric, "sweeps": [_sweeps(one) for one in environments]}
    return Section("verdict", "Verdict", context, data)


def _dots(report: Report, one: EnvironmentAnalysis, is_stretched: bool) -> dict[str, Any]:
    """The ticks of an axis from 0 to 1, and for each agent its runs on it, its median and cost."""
    agents = [agent for agent in one.agents if not math.isnan(agent.runs.mean)]
    values = [one.scores[agent.agent] * (-1 if one.is_cost else 1) for agent in agents]
    knots: Sequence[float] = SCORES if is_stretched else LINEAR
    places: Sequence[float] = STRETCHED if is_stretched else LINEAR
    if not one.is_score and agents:
        every = np.concatenate(values)
        knots, places = sorted({float(np.nanmin(every)), float(np.nanmax(every))}), (0, 1)
    costs, rows = words.processor_seconds(report.analysis.results), []
    for agent, runs in zip(agents, values, strict=True):
        ranked = np.argsort(runs)[: np.isfinite(runs).sum()]
        shown = ranked[np.linspace(0, len(ranked) - 1, min(len(ranked), MOST_DOTS)).astype(int)]
        *at, median = np.interp([*runs[shown], np.nanmedian(runs)], knots, places[: len(knots)])
        dots = zip(at, shown + report.analysis.study.first_seed, runs[shown], strict=True)
        cost = costs.get((agent.agent, one.environment))
        rows.append((agent, [*dots], median, "" if cost is None else words.duration(cost)))
    return {"rows": rows, "ticks": [*zip(places, map(number, knots), strict=False)]}


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
    context = {"tables": tables, "metric": study.metric_words}
    return Section("ranking", "Ranking", context, by_environment=True)


def _table(study: StudySpec, columns: Sequence[Column], rows: Sequence[Row]) -> dict[str, Any]:
    """The columns, the words in their headings, and each agent's cells."""
    shown, of = filled(columns, rows), rows[0].environment
    best_first: Order = "ascending" if study.metric in COSTS else "descending"
    return {
        "columns": [column for column, _ in shown],
        "orders": [column.best_first or best_first for column, _ in shown],
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
    nearest = np.abs(curve.x - share * curve.x[-1]).argmin()
    return {name: values[nearest] for name, values in vars(curve).items()}


def comparison(report: Report) -> Section | None:
    """The pairs as a table, with differences, their intervals and the seeds to decide."""
    study = report.analysis.study
    if not any(one.pairs for one in report.analysis.environments):
        return None
    context = {"metric": study.metric_words, "lower_is_better": study.metric in COSTS}
    return Section("comparison", "Differences", context, by_environment=True)


def overall(report: Report) -> Section | None:
    """Aggregates, profiles and pairs over all environments; None for a single environment."""
    overall = report.analysis.overall
    if overall is None:
        return None
    agents = list(overall.scores)
    context = {
        "agents": agents,
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
    there = {*results.summary["path"]}
    for run in results.planned:
        if str(run.path) in there:
            continue
        details, error = results.failures.get(run.path, ""), run.path / ERROR_FILE
        details = (read_text(error) if details and error.exists() else details).strip()
        reason = results.left_out.get(run.path) or details.rpartition("\n")[2] or "not done yet"
        new = {"agent": run.agent, "environment": run.environment, "reason": reason, "seeds": []}
        group = groups.setdefault((run.agent, run.environment, reason), new)
        group["seeds"].append(run.seed)
        group["details"] = details
    return list(groups.values())
