"""Figures of a study for a paper, each as PNG and SVG."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.ticker import EngFormatter, PercentFormatter

from experiments.analysis import (
    AgentAnalysis,
    EnvironmentAnalysis,
    StudyAnalysis,
)
from experiments.seed_values import mean_curve, values_over_seeds
from experiments.study_spec import METRIC_WORDS, StudySpec, file_name
from report.figures.bandit_figures import MOST_LINES, write_bandit_figures
from report.figures.figure_style import COLOURS, agent_style, figure
from verdicts import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXES = {"step": "environment steps", "episode": "episodes", "seconds": "wall time"}


def write_figures(analysis: StudyAnalysis, episodes_table: pd.DataFrame | None) -> list[Path]:
    """Draw all figures that the study has the runs for, into its folder ``figures``.

    Args:
        analysis: the study.
        episodes_table: from `report.tables.episodes_table`, or None for no such figure.

    Returns:
        The files.
    """
    folder = analysis.results.root / "figures"
    folder.mkdir(exist_ok=True)
    paths: list[Path] = []
    paths += write_bandit_figures(analysis.results, folder)
    for environment in analysis.environments:
        name = file_name(environment.environment)
        paths += _sweeps(analysis, environment, folder / f"{name}_sweep")
        if len(environment.agents) > MOST_LINES or _has_pulls(analysis, environment):
            continue
        paths += _learning_curves(analysis, environment, folder / f"{name}_learning_curves")
        paths += _intervals(analysis, environment, folder / f"{name}_intervals")
        if episodes_table is not None:
            rows = episodes_table[episodes_table["environment"] == environment.environment]
            paths += _episode_blocks(analysis.study, rows, folder / f"{name}_episodes")
    if analysis.overall is not None:
        paths += _profiles(analysis, folder / "performance_profiles")
    return paths


def _has_pulls(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> bool:
    return any(label == environment.environment for _, label in analysis.results.pulls)


def _sweeps(analysis: StudyAnalysis, environment: EnvironmentAnalysis, path: Path) -> list[Path]:
    """What the verdicts are about against the one parameter that an agent was swept over."""
    by_label = {agent.agent: agent for agent in environment.agents}
    groups: dict[str, list[tuple[float, Estimate]]] = {}
    for spec in analysis.study.agents:
        values = list(spec.swept.values())
        if spec.label in by_label and len(values) == 1 and isinstance(values[0], int | float):
            mean = by_label[spec.label].metric.mean
            (parameter,) = spec.swept
            groups.setdefault(f"{spec.group}: {parameter}", []).append((float(values[0]), mean))
    groups = {name: sorted(rows, key=lambda row: row[0]) for name, rows in groups.items()}
    groups = {name: rows for name, rows in groups.items() if len(rows) > 2}
    written: list[Path] = []
    if not groups:
        return written
    with figure(path, written) as (axes,):
        for colour, (name, rows) in zip(cycle(COLOURS), groups.items(), strict=False):
            x = [value for value, _ in rows]
            axes.plot(x, [e.point for _, e in rows], "o-", color=colour, label=name, markersize=4)
            low, high = [e.low for _, e in rows], [e.high for _, e in rows]
            axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.set(xscale="log", xlabel="value of the parameter")
        axes.set_ylabel(METRIC_WORDS[analysis.study.metric])
        axes.set_title(environment.environment, loc="left")
        axes.legend(frameon=False)
    return written


def _learning_curves(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, path: Path
) -> list[Path]:
    written: list[Path] = []
    with figure(path, written, n_columns=2) as axes:
        for place, kind, by in zip(
            axes, ("evaluation", "training"), ("step", "episode"), strict=True
        ):
            for agent in environment.agents:
                _draw_curve(place, analysis, environment, agent, kind, by)
            _draw_yardsticks(place, environment)
            place.set(xlabel=_AXES[by], ylabel="return")
            place.xaxis.set_major_formatter(EngFormatter(sep=""))
            _compress_outliers(place)
        axes[0].set_title(f"{environment.environment}: evaluations", loc="left")
        axes[1].set_title("training episodes", loc="left")
        handles, names = axes[0].get_legend_handles_labels()
        if handles:
            axes[0].figure.legend(
                handles, names, loc="outside lower center", ncols=min(len(names), 4), frameon=False
            )
    return written


def _draw_curve(
    axes: Axes,
    analysis: StudyAnalysis,
    environment: EnvironmentAnalysis,
    agent: AgentAnalysis,
    kind: str,
    by: str,
) -> None:
    curve = mean_curve(analysis.results, environment.environment, agent.agent, kind, by)
    if curve is None:
        return
    points, band = curve
    style = agent_style(analysis.study, agent.agent)
    marker = "o" if len(points) == 1 else ""
    axes.plot(points, band.point, label=agent.agent, linewidth=1.5, marker=marker, **style)
    axes.fill_between(points, band.low, band.high, color=style["color"], alpha=0.2, linewidth=0)


def _draw_yardsticks(axes: Axes, environment: EnvironmentAnalysis) -> None:
    for label, height, style in (
        ("optimum", environment.optimum, "-"),
        ("best blind policy", environment.best_blind, ":"),
    ):
        if height is not None:
            axes.axhline(height, color="0.35", linestyle=style, linewidth=1, label=label, zorder=1)


def _compress_outliers(axes: Axes) -> None:
    """Use a symmetric logarithmic axis where early returns dwarf those at the end."""
    lines = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.get_lines()]
    curves = [line[np.isfinite(line)] for line in lines if len(line) > 2]
    if not any(map(len, curves)):
        return
    settled = max(float(np.abs(curve[-len(curve) // 4 :]).max()) for curve in curves if len(curve))
    highest = max(float(np.abs(curve).max()) for curve in curves if len(curve))
    if highest > 10 * max(settled, 1.0):
        axes.set_yscale("symlog", linthresh=max(settled, 1.0))


def _intervals(analysis: StudyAnalysis, environment: EnvironmentAnalysis, path: Path) -> list[Path]:
    """Each run as a dot, the mean with its interval."""
    study, written = analysis.study, list[Path]()
    values = values_over_seeds(analysis.results, environment.environment, study.metric)
    with figure(path, written) as (axes,):
        for row, agent in enumerate(reversed(environment.agents)):
            colour = agent_style(study, agent.agent)["color"]
            runs = values[agent.agent][np.isfinite(values[agent.agent])]
            spread = np.linspace(-0.18, 0.18, len(runs)) if len(runs) > 1 else np.zeros(len(runs))
            axes.plot(runs, row + spread, ".", color=colour, alpha=0.5, markersize=5)
            mean = agent.metric.mean
            axes.plot([mean.low, mean.high], [row, row], color=colour, linewidth=5, alpha=0.35)
            axes.plot([mean.point], [row], "|", color=colour, markersize=16, markeredgewidth=2.5)
        axes.set_yticks(range(len(environment.agents)))
        axes.set_yticklabels([agent.agent for agent in reversed(environment.agents)])
        axes.set_ylim(-0.6, len(environment.agents) - 0.4)
        if study.metric in ("final", "best") and environment.optimum is not None:
            axes.axvline(environment.optimum, color="0.35", linewidth=1)
            axes.set_title(f"{environment.environment}; the line is the optimum", loc="left")
        else:
            axes.set_title(environment.environment, loc="left")
        axes.set_xlabel(f"{METRIC_WORDS[study.metric]}; mean, 95 % interval, each seed")
    return written


def _episode_blocks(study: StudySpec, rows: pd.DataFrame, path: Path) -> list[Path]:
    """Average, minimum and maximum of each block of episodes."""
    agents = list(dict.fromkeys(rows["agent"]))
    written: list[Path] = []
    if not agents:
        return written
    with figure(path, written, n_columns=len(agents)) as axes:
        for place, agent in zip(axes, agents, strict=True):
            table = rows[rows["agent"] == agent]
            for column, style in (("average", "-"), ("minimum", ":"), ("maximum", "--")):
                place.plot(
                    table["episode"],
                    table[column],
                    style,
                    marker="o",
                    markersize=3,
                    label=column,
                    color=agent_style(study, agent)["color"],
                )
            place.set_title(agent, loc="left")
            place.set(xlabel="episode", ylabel="return")
            place.legend(frameon=False)
    return written


def _profiles(analysis: StudyAnalysis, path: Path) -> list[Path]:
    written: list[Path] = []
    overall = analysis.overall
    assert overall is not None
    with figure(path, written) as (axes,):
        for agent, band in overall.profiles.items():
            style = agent_style(analysis.study, agent)
            axes.plot(overall.thresholds, band.point, label=agent, linewidth=1.5, **style)
            axes.fill_between(
                overall.thresholds,
                band.low,
                band.high,
                color=style["color"],
                alpha=0.15,
                linewidth=0,
            )
        axes.set(xlabel="score", ylabel="share of runs with a higher score", ylim=(0, 1.02))
        axes.yaxis.set_major_formatter(PercentFormatter(1))
        axes.set_title("Performance profiles over environments", loc="left")
        axes.legend(frameon=False)
    return written
