"""Figures of a study for a paper, each as PNG and SVG."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from pipeline.files import replacing
from pipeline.study.analysis import (
    AgentAnalysis,
    EnvironmentAnalysis,
    StudyAnalysis,
    mean_curve,
    values_over_seeds,
)
from pipeline.study.spec import METRIC_WORDS, StudySpec, file_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, told apart by colour-blind readers too; the line styles go on where the
# colours begin again.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = ("-", "--", "-.", ":")

_AXES = {"step": "environment steps", "episode": "episodes", "seconds": "wall time"}
_FONTS: Any = {"font.size": 10, "axes.titlesize": 11, "legend.fontsize": 9, "svg.fonttype": "none"}


def agent_style(study: StudySpec, agent: str) -> dict[str, Any]:
    """Colour and line style of an agent, the same in every figure of a study."""
    place = [spec.label for spec in study.agents].index(agent)
    return {
        "color": COLOURS[place % len(COLOURS)],
        "linestyle": STYLES[place // len(COLOURS) % len(STYLES)],
    }


def write_figures(analysis: StudyAnalysis, episodes_table: pd.DataFrame | None) -> list[Path]:
    """Draw all figures that the study has the runs for, into its folder ``figures``.

    Args:
        analysis: the study.
        episodes_table: from `pipeline.study.tables.episodes_table`, or None for no such figure.

    Returns:
        The files.
    """
    folder = analysis.results.root / "figures"
    folder.mkdir(exist_ok=True)
    paths: list[Path] = []
    for environment in analysis.environments:
        name = file_name(environment.environment)
        paths += _learning_curves(analysis, environment, folder / f"{name}_learning_curves")
        paths += _intervals(analysis, environment, folder / f"{name}_intervals")
        if episodes_table is not None:
            rows = episodes_table[episodes_table["environment"] == environment.environment]
            paths += _episode_blocks(analysis.study, rows, folder / f"{name}_episodes")
    if analysis.overall is not None:
        paths += _profiles(analysis, folder / "performance_profiles")
    return paths


@contextmanager
def _figure(path: Path, written: list[Path], n_columns: int = 1) -> Iterator[Sequence[Axes]]:
    """A row of axes, written to ``path`` as .png and .svg in the end."""
    with mpl.rc_context(_FONTS):
        figure = Figure(figsize=(6.4 * n_columns, 4.2), layout="constrained")
        axes = figure.subplots(1, n_columns, squeeze=False)[0]
        yield axes
        for place in axes:
            place.grid(alpha=0.3)
            place.spines[["top", "right"]].set_visible(False)
        for suffix, options in ((".png", {"dpi": 150}), (".svg", {"metadata": {"Date": None}})):
            target = path.with_name(path.name + suffix)
            with replacing(target) as draft:
                figure.savefig(draft, format=suffix[1:], **options)
            written.append(target)


def _learning_curves(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, path: Path
) -> list[Path]:
    written: list[Path] = []
    with _figure(path, written, n_columns=2) as axes:
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
    with _figure(path, written) as (axes,):
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
    with _figure(path, written, n_columns=len(agents)) as axes:
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
    with _figure(path, written) as (axes,):
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
