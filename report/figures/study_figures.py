"""Figures of any study: learning curves, runs, swept parameters, blocks of episodes, profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.patches import Rectangle
from matplotlib.ticker import (
    EngFormatter,
    FixedLocator,
    FuncFormatter,
    NullLocator,
    PercentFormatter,
)

from experiments.analysis import EnvironmentAnalysis, OverallAnalysis
from experiments.study import COSTS, METRIC_WORDS
from mdp.array_types import Floats
from pipeline.pictures.learning_curve import symlog_ticks
from report.figures.figure_style import (
    LOG,
    MOST_BANDS,
    REFERENCE,
    band_words,
    colour_of,
    lettering,
    line_style,
    make_room,
    shared_legend,
    width_of,
    wrapped,
)
from report.series.agent_marks import COLOURS, DASHES, Mark
from report.series.curve_series import Curve, LearningCurves, linear_up_to
from report.series.run_series import Grid, RunSeries, Sweep, best_of
from report.wording import enumeration, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXES = {"step": "environment steps", "episode": "episodes"}

ON_VARIANT = "trained on a variant of the environment"
CIRCLES_APART = 0.12  # of the length of the diagonal
NAMES = 2.1  # inches of the names of agents beside their runs
UPRIGHT = 6  # values across a heat map that have room side by side
LONGEST = 20  # letters of a value there
MOST_TICKS = 8  # values of a parameter that the axis names
FEW = 3  # names in one line of a legend
FAR = 10  # times the least of some values, the largest makes their axis logarithmic
BLOCKS = {"average": "-", "minimum": ":", "maximum": "--"}

Marks = Mapping[str, Mark]


def panels(curves: Mapping[str, LearningCurves]) -> list[tuple[str, str]]:
    """Which curves a figure has, by which axis: evaluations by step, training by episode."""
    both = (("evaluation", "step"), ("training", "episode"))
    return [(kind, by) for kind, by in both if curves[kind].by_axis[by]]


def draw_learning_curves(
    places: Sequence[Axes],
    curves: Mapping[str, LearningCurves],
    environment: EnvironmentAnalysis,
    marks: Marks,
) -> None:
    """Axes for each of the `panels`; intervals of the first agents, which are the best."""
    title = f"{environment.environment}: "
    for place, (kind, by) in zip(places, panels(curves), strict=True):
        found = curves[kind]
        # Before the lines: limits are chosen on the scale that there is.
        _set_scale(place, found.linear_up_to)
        _draw_curves(place, found.by_axis[by], marks)
        for agent, curve in found.by_axis[by].items():
            if agent in found.on_variant:
                _mark_variant(place, curve, marks[agent])
        if not found.on_variant:
            _draw_references(place, environment)
        title += "evaluations" if kind == "evaluation" else _training_title(found.on_variant)
        lettering(place, title=title, x=_AXES[by], y=f"return{_beyond(found.linear_up_to)}")
        place.xaxis.set_major_formatter(EngFormatter(sep=""))
        title = ""
    if curves["training"].on_variant:
        # The legend below tells what the circles are.
        places[0].plot([], [], "o", color=REFERENCE, markerfacecolor="white", label=ON_VARIANT)
    shared_legend(*places, band=band_words(len(environment.agents)))


def _draw_curves(axes: Axes, curves: Mapping[str, Curve], marks: Marks) -> None:
    """Curves, the first ones with their intervals."""
    for place, (agent, curve) in enumerate(curves.items()):
        style = line_style(marks[agent])
        marker = "o" if len(curve.x) == 1 else ""  # which has no length
        axes.plot(curve.x, curve.y, label=agent, linewidth=1.5, marker=marker, **style)
        if place < MOST_BANDS:
            axes.fill_between(
                curve.x, curve.low, curve.high, color=style["color"], alpha=0.2, linewidth=0
            )


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


def _beyond(linear_up_to: float | None) -> str:
    """What the name of an axis says of its scale."""
    return "" if linear_up_to is None else f" (log scale beyond ±{number(linear_up_to)})"


def _set_scale(axes: Axes, linear_up_to: float | None) -> None:
    """Make the upright axis logarithmic where early returns dwarf those that matter."""
    if linear_up_to is not None:
        axes.set_yscale("symlog", linthresh=linear_up_to)
        axes.yaxis.set_major_locator(FixedLocator(symlog_ticks(linear_up_to)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _signed(value)))


def _signed(value: float) -> str:
    """A number as Matplotlib's own axes have it."""
    return number(value).replace("-", "\N{MINUS SIGN}")


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
        axes.plot([mean.point], [row], "|", color=colour, markersize=16, markeredgewidth=1.5)
    names = [wrapped(agent.agent, NAMES) for agent in upwards]
    axes.set_yticks(range(len(upwards)), names)
    make_room(axes, names)
    axes.set_ylim(-0.6, len(upwards) - 0.4)
    title = environment.environment
    if metric in ("final", "best") and environment.optimum is not None:
        axes.axvline(environment.optimum, color=REFERENCE, linewidth=1)
        if environment.optimum_at_least is None:
            title += "; the line is the optimum"
        else:
            axes.axvline(environment.optimum_at_least, color=REFERENCE, linewidth=1)
            title += "; the optimum lies between the lines"
    x = f"{METRIC_WORDS[metric]}; mean, 95 % interval, each seed"
    widest = max(width_of(line) for name in names for line in name.split("\n"))
    lettering(axes, title=title, x=x, beside=widest + 0.3)


def draw_sweeps(
    axes: Axes, sweeps: Mapping[str, Sweep], environment: EnvironmentAnalysis, metric: str
) -> None:
    """What the verdicts are about against the one parameter that agents were swept over."""
    names = list(dict.fromkeys(sweep.parameter for sweep in sweeps.values()))
    values = np.unique(np.concatenate([sweep.means.x for sweep in sweeps.values()]))
    words = _set_scale_of_values(axes, values)
    for place, (group, sweep) in enumerate(sweeps.items()):
        style = line_style(Mark(group, place % len(COLOURS), DASHES[place % len(DASHES)]))
        curve = sweep.means
        label = group if len(names) == 1 else f"{group}, {sweep.parameter}"
        axes.plot(curve.x, curve.y, marker="o", label=label, markersize=4, **style)
        if place < MOST_BANDS:
            axes.fill_between(
                curve.x, curve.low, curve.high, color=style["color"], alpha=0.2, linewidth=0
            )
    best = best_of(environment, [label for sweep in sweeps.values() for label in sweep.labels])
    rings = [
        (x, y)
        for sweep in sweeps.values()
        for label, x, y in zip(sweep.labels, sweep.means.x, sweep.means.y, strict=True)
        if label in best
    ]
    if rings:
        x, y = np.transpose(rings)
        label = f"best: {enumeration(best)}" if len(best) <= FEW else "best"
        axes.scatter(x, y, 90, "none", edgecolor="black", label=label, zorder=3)
    if len(values) <= MOST_TICKS:
        axes.xaxis.set_major_locator(FixedLocator(values.tolist()))
        axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
    across = names[0] if len(names) == 1 else "value of the parameter"
    lettering(axes, title=environment.environment, x=across + words, y=METRIC_WORDS[metric])
    shared_legend(axes, band=band_words(len(sweeps)))


def _set_scale_of_values(axes: Axes, values: Floats) -> str:
    """Make the axis of a parameter logarithmic where its values go far; what its name says then."""
    least = float(values[values > 0].min(initial=np.inf))
    if values.min() < 0 or values.max() < FAR * least:
        return ""
    if values.min() > 0:
        axes.set_xscale("log")
        return f" {LOG}"
    axes.set_xscale("symlog", linthresh=least)
    return f" (log scale beyond {number(least)})"


def draw_grid(
    axes: Axes, grid: Grid, title: str, environment: EnvironmentAnalysis, metric: str
) -> None:
    """The means over two swept parameters as a heat map, the best in frames."""
    shares = grid.shares(is_cost=metric in COSTS)  # the darker the better
    colours = mpl.colormaps["Blues"](0.05 + 0.75 * shares)
    axes.pcolormesh(*map(_edges, grid.means.shape[::-1]), colours, edgecolor="white", linewidth=1)
    best = best_of(environment, [label for row in grid.labels for label in row])
    for (row, column), mean in np.ndenumerate(grid.means):
        if not np.isnan(mean):
            ink = "white" if shares[row, column] > 0.6 else "black"
            axes.text(column, row, number(mean), color=ink, ha="center", va="center", size=8)
        if grid.labels[row][column] in best:
            frame = Rectangle((column - 0.46, row - 0.44), 0.92, 0.88, fill=False, linewidth=2)
            frame.set_edgecolor(COLOURS[1])
            axes.add_patch(frame)
    axes.invert_yaxis()
    axes.grid(visible=False)
    down, across = ([_brief(text) for text in texts] for texts in (grid.down, grid.across))
    turned = 90 if len(across) > UPRIGHT else 0
    axes.set_xticks(range(len(across)), across, rotation=turned)
    axes.set_yticks(range(len(down)), down)
    axes.tick_params(length=0)
    y, x = grid.parameters
    frames = "a frame" if len(best) == 1 else "frames"
    title += f": {METRIC_WORDS[metric]}, means over seeds; the best in {frames}"
    lettering(axes, title=title, x=x, y=y, beside=1.8)


def _brief(text: str) -> str:
    """A value on an axis, in at most two lines."""
    return wrapped(text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…", 1.0)


def _edges(n: int) -> Floats:
    """Of cells whose middles are 0, 1, 2 and so on."""
    return np.arange(-0.5, n)


def draw_blocks(axes: Axes, rows: pd.DataFrame, mark: Mark) -> None:
    """Average, minimum and maximum of each block of an agent's episodes."""
    scale = linear_up_to([rows[column].to_numpy(float) for column in BLOCKS], None)
    _set_scale(axes, scale)
    for column, style in BLOCKS.items():
        colour = colour_of(mark)
        axes.plot(rows["episode"], rows[column], style, marker="o", markersize=3, color=colour)
    lettering(axes, title=mark.label, x="episode", y=f"return{_beyond(scale)}")


def name_blocks(axes: Axes) -> None:
    """Tell below the figure what the lines of all blocks are."""
    for label, style in BLOCKS.items():
        axes.plot([], [], style, marker="o", markersize=3, color=REFERENCE, label=label)
    shared_legend(axes)


def draw_profiles(axes: Axes, overall: OverallAnalysis, marks: Marks) -> None:
    """The share of runs whose score is higher than each threshold."""
    x, found = overall.thresholds, overall.profiles
    curves = {agent: Curve(x, band.point, band.low, band.high) for agent, band in found.items()}
    _draw_curves(axes, curves, marks)
    axes.set_ylim(0, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    title = "Performance profiles over environments"
    lettering(axes, title=title, x="score", y="share of runs with a higher score")
    shared_legend(axes, band=band_words(len(curves)))
