"""Figures of any study: learning curves, runs, swept parameters, blocks of episodes, profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.ticker import EngFormatter, FixedLocator, FuncFormatter, PercentFormatter

from experiments.analysis import EnvironmentAnalysis
from experiments.overall_analysis import OverallAnalysis
from experiments.study_spec import METRIC_WORDS
from pipeline.pictures.learning_curve import symlog_ticks
from report.figures.figure_style import REFERENCE, colour_of, line_style, shared_legend
from report.series.agent_marks import COLOURS, Mark
from report.series.curve_series import Curve, LearningCurves
from report.series.run_series import RunSeries
from report.wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXES = {"step": "environment steps", "episode": "episodes"}

ON_VARIANT = "trained on a variant of the environment"
CIRCLES_APART = 0.12  # of the length of the diagonal

Marks = Mapping[str, Mark]


def draw_learning_curves(
    places: Sequence[Axes],
    curves: Mapping[str, LearningCurves],
    environment: EnvironmentAnalysis,
    marks: Marks,
) -> None:
    """Evaluations by step on the first axes, training by episode on the second."""
    for place, kind, by in zip(
        places, ("evaluation", "training"), ("step", "episode"), strict=True
    ):
        # Before the lines: limits are chosen on the scale that there is.
        _set_scale(place, curves[kind].linear_up_to)
        for agent, curve in curves[kind].by_axis[by].items():
            _draw_curve(place, curve, marks[agent])
            if agent in curves[kind].on_variant:
                _mark_variant(place, curve, marks[agent])
        if not curves[kind].on_variant:
            _draw_references(place, environment)
        place.set(xlabel=_AXES[by], ylabel="return")
        place.xaxis.set_major_formatter(EngFormatter(sep=""))
    places[0].set_title(f"{environment.environment}: evaluations", loc="left")
    places[1].set_title(_training_title(curves["training"].on_variant), loc="left")
    if curves["training"].on_variant:
        # The legend below is of these axes: it tells what the circles on the others are.
        places[0].plot([], [], "o", color=REFERENCE, markerfacecolor="white", label=ON_VARIANT)
    shared_legend(places[0])


def _mark_variant(axes: Axes, curve: Curve, mark: Mark) -> None:
    """Circles along a curve, which tell it from the others without colour."""
    colour = colour_of(mark)
    hollow = axes.plot(curve.x, curve.y, "o", color=colour, markerfacecolor="white", markersize=5)
    hollow[0].set_markevery(CIRCLES_APART)


def _training_title(on_variant: Sequence[str]) -> str:
    if not on_variant:
        return "training episodes"
    names = on_variant[0] if len(on_variant) == 1 else f"{len(on_variant)} agents"
    return f"training episodes ({names}: on a variant of the environment)"


def _set_scale(axes: Axes, linear_up_to: float | None) -> None:
    """Make the upright axis logarithmic where early returns dwarf those that matter."""
    if linear_up_to is not None:
        axes.set_yscale("symlog", linthresh=linear_up_to)
        axes.yaxis.set_major_locator(FixedLocator(symlog_ticks(linear_up_to)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))


def _draw_curve(axes: Axes, curve: Curve, mark: Mark, alpha: float = 0.2) -> None:
    marker = "o" if len(curve.x) == 1 else ""
    style = line_style(mark)
    axes.plot(curve.x, curve.y, label=mark.label, linewidth=1.5, marker=marker, **style)
    axes.fill_between(
        curve.x, curve.low, curve.high, color=style["color"], alpha=alpha, linewidth=0
    )


def _draw_references(axes: Axes, environment: EnvironmentAnalysis) -> None:
    is_known = environment.optimum_at_least is None
    for label, height, style in (
        ("optimum" if is_known else "optimum, at most", environment.optimum, "-"),
        ("optimum, at least", environment.optimum_at_least, "--"),
        ("best random or constant policy", environment.baseline, ":"),
    ):
        if height is not None:
            axes.axhline(
                height, color=REFERENCE, linestyle=style, linewidth=1, label=label, zorder=1
            )


def draw_runs(
    axes: Axes, runs: RunSeries, environment: EnvironmentAnalysis, metric: str, marks: Marks
) -> None:
    """Each run as a dot, the mean with its interval; the best agent on top."""
    upwards = runs.agents[::-1]
    for row, agent in enumerate(upwards):
        colour = colour_of(marks[agent.agent])
        n = len(agent.values)
        spread = np.linspace(-0.18, 0.18, n) if n > 1 else np.zeros(n)
        axes.plot(agent.values, row + spread, ".", color=colour, alpha=0.5, markersize=5)
        mean = agent.mean
        axes.plot([mean.low, mean.high], [row, row], color=colour, linewidth=5, alpha=0.35)
        axes.plot([mean.point], [row], "|", color=colour, markersize=16, markeredgewidth=2.5)
    axes.set_yticks(range(len(upwards)), [agent.agent for agent in upwards])
    axes.set_ylim(-0.6, len(upwards) - 0.4)
    title = environment.environment
    if metric in ("final", "best") and environment.optimum is not None:
        axes.axvline(environment.optimum, color=REFERENCE, linewidth=1)
        if environment.optimum_at_least is None:
            title += "; the line is the optimum"
        else:
            axes.axvline(environment.optimum_at_least, color=REFERENCE, linewidth=1)
            title += "; the optimum lies between the lines"
    axes.set_title(title, loc="left")
    axes.set_xlabel(f"{METRIC_WORDS[metric]}; mean, 95 % interval, each seed")


def draw_sweeps(axes: Axes, sweeps: Mapping[str, Curve], place: str, metric: str) -> None:
    """What the verdicts are about against the one parameter that an agent was swept over."""
    for colour, (name, curve) in zip(cycle(COLOURS), sweeps.items(), strict=False):
        axes.plot(curve.x, curve.y, "o-", color=colour, label=name, markersize=4)
        axes.fill_between(curve.x, curve.low, curve.high, color=colour, alpha=0.2, linewidth=0)
    axes.set(xscale="log", xlabel="value of the parameter", ylabel=METRIC_WORDS[metric])
    axes.set_title(place, loc="left")
    axes.legend(frameon=False)


def draw_blocks(axes: Axes, rows: pd.DataFrame, mark: Mark) -> None:
    """Average, minimum and maximum of each block of an agent's episodes."""
    for column, style in (("average", "-"), ("minimum", ":"), ("maximum", "--")):
        axes.plot(
            rows["episode"],
            rows[column],
            style,
            marker="o",
            markersize=3,
            label=column,
            color=colour_of(mark),
        )
    axes.set_title(mark.label, loc="left")
    axes.set(xlabel="episode", ylabel="return")
    axes.legend(frameon=False)


def draw_profiles(axes: Axes, overall: OverallAnalysis, marks: Marks) -> None:
    """The share of runs whose score is higher than each threshold."""
    for agent, band in overall.profiles.items():
        curve = Curve(overall.thresholds, band.point, band.low, band.high)
        _draw_curve(axes, curve, marks[agent], alpha=0.15)
    axes.set(xlabel="score", ylabel="share of runs with a higher score", ylim=(0, 1.02))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.set_title("Performance profiles over environments", loc="left")
    axes.legend(frameon=False)
