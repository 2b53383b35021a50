"""Figures of a study for a paper: PNG, SVG and PDF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib import ticker
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Patch, Rectangle
from matplotlib.textpath import TextToPath
from matplotlib.transforms import offset_copy

from rl_yardstick.experiments.analysis import EnvironmentAnalysis
from rl_yardstick.experiments.study import COSTS, METRIC_WORDS, StudySpec, file_name
from rl_yardstick.mdp.transition_model import Floats, Ints
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.report import series
from rl_yardstick.report.series import EnvironmentSeries, Mark, PullSeries, StudySeries
from rl_yardstick.report.words import enumeration, number, with_best_mean

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# The style of a study's figures, and how they are saved.
#
# A figure is as wide as the text of a page, so that it is printed unscaled. Long labels wrap.

# Matplotlib's names for Plotly's line styles.
_LINE_STYLES: Mapping[series.Dash, str] = {"solid": "-", "dash": "--", "dashdot": "-.", "dot": ":"}

REFERENCE = "0.35"  # the grey of reference lines
MOST_BANDS = 5  # the largest number of shaded intervals in a figure: more would hide each other

# Inches.
WIDTH, HEIGHT = 6.5, 2.7  # of a row of panels
_BESIDE, _BELOW = 0.85, 0.8  # space for tick labels and axis labels of a panel
_LINE = 0.14  # from one line of small print to the next

_SMALL, _PLAIN, _TITLE = 8, 9, 9.5
_FONTS: Any = {
    "font.size": _PLAIN,
    "axes.titlesize": _TITLE,
    "axes.labelsize": _PLAIN,
    "xtick.labelsize": _SMALL,
    "ytick.labelsize": _SMALL,
    "legend.fontsize": _SMALL,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,  # TrueType, which publishers ask for
}
FORMATS = ("png", "svg", "pdf")
_UNDATED = {"svg": {"metadata": {"Date": None}}, "pdf": {"metadata": {"CreationDate": None}}}

LOG = "(log scale)"


def line_style(mark: Mark) -> dict[str, Any]:
    """Colour and line style of an agent, as Matplotlib's functions take them."""
    return {"color": series.COLOURS[mark.colour], "linestyle": _LINE_STYLES[mark.dash]}


def fill_band(axes: Axes, band: series.Curve, mark: Mark, alpha: float = 0.2) -> None:
    """Shade the interval of a curve."""
    style = {"color": series.COLOURS[mark.colour], "alpha": alpha, "linewidth": 0}
    axes.fill_between(band.x, band.low, band.high, **style)  # type: ignore[arg-type]


@dataclass(frozen=True)
class FigureFiles:
    """Saves figures as files."""

    folder: Path  # of the files
    formats: Sequence[str]  # among "png", "svg", "pdf"
    written: list[Path] = field(default_factory=list)  # the files so far

    @contextmanager
    def figure(
        self, name: str, n_columns: int = 1, n_rows: int = 1, height: float = HEIGHT
    ) -> Iterator[Sequence[Axes]]:
        """Yield axes row by row, ``height`` inches each; on exit save the figure as ``name``."""
        with mpl.rc_context(_FONTS):
            # The resolution is that of the PNG; the other formats have none.
            canvas = Figure(figsize=(WIDTH, height * n_rows), dpi=300, layout="constrained")
            axes = list(canvas.subplots(n_rows, n_columns, squeeze=False).flat)
            for place in axes:
                place.grid(alpha=0.3)
                place.spines[["top", "right"]].set_visible(False)
            yield axes
            for form in sorted(set(self.formats), key=FORMATS.index):
                self.written.append(self.folder / f"{name}.{form}")
                backend = f"matplotlib.backends.backend_{'agg' if form == 'png' else form}"
                # By its backend: `savefig` would draw twice, first for the layout.
                draw_on = import_module(backend).FigureCanvas(canvas)
                with replacing(self.written[-1]) as beside:
                    getattr(draw_on, f"print_{form}")(beside, **_UNDATED.get(form, {}))
                # The other formats keep the layout of the first: computing it takes longest.
                canvas.set_layout_engine("none")


def width_of(text: str, size: float = _SMALL) -> float:
    """The width of a line in inches."""
    font = FontProperties(size=size)
    return TextToPath().get_text_width_height_descent(text, font, ismath=False)[0] / 72


def wrapped(text: str, width: float, size: float = _SMALL) -> str:
    """Wrap a text into lines of at most ``width`` inches, and escape dollar signs."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".lstrip()
        if width_of(longer, size) <= width:
            lines[-1] = longer
            continue
        lines += [""] if lines[-1] else []
        for letter in word:
            if lines[-1] and width_of(lines[-1] + letter, size) > width:
                lines.append("")
            lines[-1] += letter
    return "\n".join(lines).replace("$", r"\$")


def lettering(
    axes: Axes, *, title: str = "", x: str = "", y: str = "", beside: float = _BESIDE
) -> None:
    """Set the title and the axis labels; ``beside`` is the space left of the axes, in inches."""
    figure, spec = _figure_of(axes), axes.get_subplotspec()
    n_rows, n_columns = (1, 1) if spec is None else spec.get_gridspec().get_geometry()
    y = wrapped(y, max(figure.get_figheight() / n_rows - _BELOW, 1.0), _PLAIN)
    beside += 0.17 * y.count("\n")
    width = max(figure.get_figwidth() / n_columns - beside, 1.0)
    axes.set_title(wrapped(title, width, _TITLE), loc="left")
    axes.set_xlabel(wrapped(x, width, _PLAIN))
    axes.set_ylabel(y)


def _figure_of(axes: Axes) -> Figure:
    found = axes.get_figure(root=True)
    assert found is not None
    return found


def shared_legend(*places: Axes, n_bands: int = 0) -> None:
    """Add one legend for all axes below the figure, and make the figure higher for it.

    ``n_bands`` curves have shaded intervals, or the first `MOST_BANDS` of them.
    """
    named = [axes.get_legend_handles_labels() for axes in places]
    found = {name: handle for some in named for handle, name in zip(*some, strict=True)}
    if not found:
        return
    # Agents before references.
    grey = {name for name in found if getattr(found[name], "get_color", str)() == REFERENCE}
    found = {name: found[name] for name in sorted(found, key=grey.__contains__)}
    if n_bands:
        band = "95 % interval" + (f", of the first {MOST_BANDS}" if n_bands > MOST_BANDS else "")
        found[band] = Patch(color=REFERENCE, alpha=0.2, linewidth=0)
    figure = _figure_of(places[0])
    names = [wrapped(name, figure.get_figwidth() / 2 - 0.8) for name in found]
    lines = [name.split("\n") for name in names]
    widest = max(width_of(line) for name in lines for line in name) + 0.65
    n_columns = min(len(names), max(int((figure.get_figwidth() - 0.3) / widest), 1))
    n_rows = -(-len(names) // n_columns) * max(map(len, lines))
    figure.set_figheight(figure.get_figheight() + _LINE * (n_rows + 1))
    style = {"ncols": n_columns, "frameon": False, "handlelength": 2.5}  # as long as a dash and dot
    figure.legend([*found.values()], names, loc="outside lower center", **style)


# Figures of bandits, in the forms of the textbooks.

Marks = Mapping[str, Mark]
Line = tuple[str, Ints, Floats, Mapping[str, str]]  # name, x, y, style

_PULLS = f"pulls {LOG}"
UPRIGHT = 6  # the largest number of names that fit side by side


def draw_rewards(upper: Axes, lower: Axes, bandit: PullSeries, place: str, marks: Marks) -> None:
    """Average reward and share of optimal arms by pull: figure 2.2 of Sutton and Barto."""
    rewards = _by_pull(bandit, "reward", marks)
    if bandit.best is not None:
        pulls = rewards[0][1][[0, -1]]
        style = {"color": REFERENCE, "linestyle": "-"}
        rewards.append(("best possible", pulls, np.full(2, bandit.best), style))
    _draw_lines(upper, rewards)
    lettering(
        upper, title=f"{place}, {bandit.n_runs:,} runs", x="pulls", y="average reward per pull"
    )
    lower.set_ylim(0, 1)
    _draw_lines(lower, _by_pull(bandit, "optimal", marks))
    lower.yaxis.set_major_formatter(ticker.PercentFormatter(1))
    lettering(lower, x="pulls", y="runs that pull a best arm")
    shared_legend(upper, lower)


def _by_pull(bandit: PullSeries, what: str, marks: Marks) -> list[Line]:
    found = [(agent, p, getattr(p, what)) for agent, p in bandit.pulls.items()]
    known = [one for one in found if np.isfinite(one[-1]).any()]
    return [(agent, p.pulls, y, line_style(marks[agent])) for agent, p, y in known]


def _draw_lines(axes: Axes, lines: Sequence[Line]) -> None:
    for name, x, y, style in lines:
        axes.plot(x, y, label=name, linewidth=1, **style)  # type: ignore[arg-type]


def draw_regret(places: Sequence[Axes], bandit: PullSeries, place: str, marks: Marks) -> None:
    """Cumulative regret on a logarithmic axis of pulls, with the bounds from theory.

    On the second axes, if there are any, simple regret: the best mean reward less that of the arm
    pulled most so far.
    """
    axes, *others = places
    for each in places:
        each.set_xscale("log")
    for each in others:
        _draw_lines(each, _by_pull(bandit, "simple_regret", marks))
        title = "of recommending the arm pulled most"
        lettering(each, title=title, x=_PULLS, y="simple regret (reward per pull)")
    lines = _by_pull(bandit, "cumulative_regret", marks)
    # The interval of the mean and the spread of runs, or fewer bands where agents are many.
    kinds = [(series.mean_regret, 0.3), (series.regret_of_runs, 0.08)]
    kinds = kinds[: MOST_BANDS // len(bandit.pulls)]
    for agent, pulls in bandit.pulls.items():
        for curve_of, alpha in kinds:
            fill_band(axes, curve_of(pulls), marks[agent], alpha)
    words = ("", " with its 95 % interval", f", its 95 % interval, and {series.SPREAD} of the runs")
    title = f"{place}: mean of {bandit.n_runs:,} runs{words[len(kinds)]}"
    highest = max(axes.dataLim.y1, *(np.nanmax(y) for _, _, y, _ in lines))
    if bandit.bounds is not None:
        # A bound far above is cut, and an agent that never learns does not flatten the rest.
        bounds, shown = bandit.bounds, bandit.bounds.auer <= 1.5 * highest
        for name, x, y, dash in (
            ("Auer's bound for UCB1", bounds.pulls[shown], bounds.auer[shown], "--"),
            ("Lai-Robbins slope", bounds.pulls, bounds.lai_robbins, ":"),
        ):
            lines.append((name, x, y, {"color": REFERENCE, "linestyle": dash}))
        highest = min(highest, float(bounds.auer[-1]))
    axes.set_ylim(0, 1.05 * highest)
    _draw_lines(axes, lines)
    lettering(axes, title=title, x=_PULLS, y="cumulative regret (reward)")
    shared_legend(*places)


def draw_arms(upper: Axes, lower: Axes, arms: series.ArmSeries, marks: Marks) -> None:
    """By context, each arm's share of the pulls, and the final estimates of its mean."""
    places = np.arange(len(arms.names))
    width = 0.8 / len(arms.shares)
    for index, (agent, shares) in enumerate(arms.shares.items()):
        colour = series.COLOURS[marks[agent].colour]
        offset = places + (index - (len(arms.shares) - 1) / 2) * width
        upper.bar(offset, shares, width, color=colour, label=agent)
        if agent in arms.estimates:
            mean, std = arms.estimates[agent]
            lower.errorbar(offset, mean, std, fmt="o", markersize=3, linewidth=1, color=colour)
    lower.hlines(arms.means, places - 0.42, places + 0.42, color="black", linewidth=1, zorder=3)
    upright = len(arms.names) <= UPRIGHT
    for axes in (upper, lower):
        names = [name.replace(", ", "\n" if upright else ", ") for name in arms.names]
        axes.set_xticks(places, names, rotation=0 if upright else 90)
    upper.set_ylim(0, 1)
    upper.yaxis.set_major_formatter(ticker.PercentFormatter(1))
    lettering(upper, title="pulls, by context", y="share of the pulls")
    title = "final estimates, mean and spread over runs; lines across are the truth"
    lettering(lower, title=title, y="mean reward per pull")
    shared_legend(upper)


def draw_belief(panels: Sequence[Axes], belief: series.Belief) -> None:
    """An agent's posterior of each arm in its first run, a panel per context and moment."""
    n_moments, n_contexts, n_arms, _ = belief.densities.shape
    for panel, axes in enumerate(panels):
        context, moment = divmod(panel, n_moments)
        for arm in range(n_arms):
            colour = series.COLOURS[arm % series.N_KINDS]
            y = belief.densities[moment, context, arm]
            axes.plot(belief.points, y, linewidth=1.2, label=f"arm {arm}", color=colour)
            mean = belief.true_means[context][arm]
            if mean is not None:
                axes.axvline(mean, color=colour, linestyle=":", linewidth=1)
        where = f", context {context}" if n_contexts > 1 else ""
        title = f"{belief.agent}{where}, after {belief.moments[moment]:,} pulls"
        lettering(axes, title=title, x="mean reward per pull", y="density")
    shared_legend(*panels)


# Figures of any study: learning curves, runs, swept parameters, profiles.

_AXES = {"step": "environment steps", "episode": "episodes"}

ON_VARIANT = "trained on a variant of the environment"
CIRCLES_APART = 0.12  # of the diagonal of the axes
NAMES = 2.1  # inches, the width of the names of agents beside their runs
LONGEST = 20  # letters of a value on an axis
MOST_TICKS = 8  # the largest number of values of a parameter with a tick each
_BETWEEN = "; the optimum lies between the lines"
FEW = 3  # the largest number of names in a legend's entry


def panels(curves: Mapping[str, series.LearningCurves]) -> list[tuple[str, str]]:
    """The kind of curve and the x axis of each panel: that of the budget, and episodes."""
    both = (("evaluation", curves["evaluation"].budget), ("training", "episode"))
    return [(kind, by) for kind, by in both if curves[kind].by_axis[by]]


def draw_learning_curves(places: Sequence[Axes], one: EnvironmentSeries, marks: Marks) -> None:
    """Draw each of the `panels` on its axes, with intervals for the first (best) agents."""
    assert one.curves is not None
    curves, environment = one.curves, one.environment
    kinds, on_variant = panels(curves), curves["training"].on_variant
    scales = {kind: curves[kind].linear_up_to for kind, _ in kinds}
    # Returns on a variant are another metric, with an axis of its own.
    if not on_variant:
        known = [scale for scale in scales.values() if scale is not None]
        scales = dict.fromkeys(scales, known[0] if known else None)
        for axes in places[1:]:
            axes.sharey(places[0])
    for axes, (kind, by) in zip(places, kinds, strict=True):
        found = curves[kind]
        # Before the lines, because the limits depend on the scale.
        words = _set_scale(axes, scales[kind])
        for place, (agent, curve) in enumerate(found.by_axis[by].items()):
            marker = "o" if len(curve.x) == 1 else ""  # a single point draws no line
            style = line_style(marks[agent])
            axes.plot(curve.x, curve.y, label=agent, linewidth=1.5, marker=marker, **style)
            if place < MOST_BANDS:
                fill_band(axes, curve, marks[agent])
        for agent in filter(found.by_axis[by].__contains__, found.on_variant):
            # Circles mark the curve of a variant without colour.
            curve, colour = found.by_axis[by][agent], series.COLOURS[marks[agent].colour]
            (circles,) = axes.plot(curve.x, curve.y, "o", ms=5, mfc="white", color=colour)
            circles.set_markevery(CIRCLES_APART)
        title = f"{environment.environment}: " if axes is places[0] else ""
        title += "evaluations" if kind == "evaluation" else "training episodes"
        if found.on_variant:
            n = len(on_variant)
            names = on_variant[0] if n == 1 else f"{n} agents"
            title += f" ({names}: on a variant of the environment)"
        else:
            _draw_references(axes, environment)
        lettering(axes, title=title, x=_AXES[by], y=f"return{words}")
        axes.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
    if on_variant:  # the legend's entry for the circles
        places[0].plot([], [], "o", color=REFERENCE, markerfacecolor="white", label=ON_VARIANT)
    shared_legend(*places, n_bands=len(environment.agents))


MOST_POWERS = 12  # powers of ten on an axis


def symlog_ticks(linear_up_to: float) -> list[float]:
    """Ticks of a symmetric logarithmic axis: 0, one in the linear part, two for each power."""
    power = math.floor(math.log10(linear_up_to))
    within = max(m for m in (1, 2, 5) if m * 10.0**power <= linear_up_to) * 10.0**power
    beyond = [m * 10.0**k for k in range(power, power + MOST_POWERS) for m in (1, 3)]
    sizes = [within, *(size for size in beyond if size > linear_up_to)]
    return [-size for size in reversed(sizes)] + [0.0, *sizes]


def _set_scale(axes: Axes, linear_up_to: float | None) -> str:
    """Make the y axis logarithmic beyond ``linear_up_to``, if given; return words for its label."""
    if linear_up_to is None:
        return ""
    axes.set_yscale("symlog", linthresh=linear_up_to)
    axes.yaxis.set_major_locator(ticker.FixedLocator(symlog_ticks(linear_up_to)))
    axes.yaxis.set_minor_locator(ticker.NullLocator())
    # With the minus sign of Matplotlib's own axes.
    signed = ticker.FuncFormatter(lambda value, _: number(value).replace("-", "\N{MINUS SIGN}"))
    axes.yaxis.set_major_formatter(signed)
    return f" (log scale beyond ±{number(linear_up_to)})"


def _draw_references(axes: Axes, environment: EnvironmentAnalysis) -> None:
    most = "optimum"
    if environment.optimum_at_least is not None:
        most += ", at most" + ("" if environment.optimum_is_proven else " (not proven)")
    for label, height, style in (
        (most, environment.optimum, "-"),
        ("optimum, at least", environment.optimum_at_least, "--"),
        ("best random or constant policy", environment.baseline, ":"),
    ):
        if height is not None:
            axes.axhline(height, color=REFERENCE, ls=style, lw=1, label=label, zorder=1)


def draw_runs(axes: Axes, one: EnvironmentSeries, study: StudySpec, marks: Marks) -> None:
    """Each run as a dot, the mean with its interval; the best agent on top."""
    environment, upwards = one.environment, one.environment.agents[::-1]
    means = [agent.metric.mean for agent in upwards]
    for row, (agent, mean) in enumerate(zip(upwards, means, strict=True)):
        colour, values = series.COLOURS[marks[agent.agent].colour], environment.values[agent.agent]
        n = len(values := values[np.isfinite(values)])
        spread = np.linspace(-0.18, 0.18, n) if n > 1 else np.zeros(n)
        axes.plot(values, row + spread, ".", color=colour, alpha=0.5, markersize=5)
        bar = "D" if mean.low == mean.high else "-"  # a bar of no length is invisible
        axes.plot([mean.low, mean.high], [row, row], bar, color=colour, lw=5, ms=7, alpha=0.35)
        axes.plot([mean.point], [row], "|", color=colour, markersize=16, markeredgewidth=1.5)
    names = [wrapped(agent.agent, NAMES) for agent in upwards]
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    lines = max(name.count("\n") + 1 for name in names)
    _figure_of(axes).set_figheight(1.1 + len(names) * max(0.32, _LINE * lines + 0.04))
    title = environment.environment
    if study.metric in ("final", "best") and environment.optimum is not None:
        at_least = environment.optimum_at_least
        for end in (environment.optimum, at_least):
            if end is not None:
                axes.axvline(end, color=REFERENCE, linewidth=1)
        title += "; the line is the optimum" if at_least is None else _BETWEEN
        title += "" if environment.optimum_is_proven else " (the upper one is not proven)"
    ends = "range" if all(mean.is_range for mean in means) else "95 % interval"
    x = f"{study.metric_words}; mean, {ends}, each seed"
    x += "; diamond: all runs are equal" if any(m.low == m.high for m in means) else ""
    title += f"; best: {environment.best}" if len(means) > 1 else ""
    widest = max(width_of(line) for name in names for line in name.split("\n"))
    lettering(axes, title=title, x=x, beside=widest + 0.3)


def draw_sweeps(axes: Axes, one: EnvironmentSeries, metric: str) -> None:
    """The metric by the swept parameter, for agents swept over one parameter."""
    sweeps, environment = one.sweeps, one.environment
    names = list(dict.fromkeys(sweep.parameter for sweep in sweeps.values()))
    values = np.unique(np.concatenate([sweep.means.x for sweep in sweeps.values()]))
    words = _set_scale_of_values(axes, values)
    best = with_best_mean(environment, *(sweep.labels for sweep in sweeps.values()))
    rings: list[list[float]] = []
    for place, (group, sweep) in enumerate(sweeps.items()):
        mark = Mark(group, place % series.N_KINDS, series.DASHES[place % len(series.DASHES)])
        x, y = sweep.means.x, sweep.means.y
        label = group if len(names) == 1 else f"{group}, {sweep.parameter}"
        axes.plot(x, y, marker="o", label=label, markersize=4, **line_style(mark))
        if place < MOST_BANDS:  # a bar each: a band needs two neighbours with an interval
            aside = 5 * (place - (min(len(sweeps), MOST_BANDS) - 1) / 2)
            at = offset_copy(axes.transData, _figure_of(axes), x=aside, units="points")
            ends, colour = (sweep.means.low, sweep.means.high), series.COLOURS[mark.colour]
            axes.vlines(x, *ends, color=colour, alpha=0.35, linewidth=4, transform=at)
            axes.update_datalim(np.column_stack([np.tile(x, 2), np.concatenate(ends)]))
        rings += [at for *at, name in zip(x, y, sweep.labels, strict=True) if name in best]
    axes.autoscale_view()
    if rings:
        prefix = f"{next(iter(sweeps))} with " if len(sweeps) == 1 else ""
        told = enumeration([label.removeprefix(prefix) for label in best])
        label = f"best mean: {told}" if len(best) <= FEW else "best mean"
        x, y = np.transpose(rings)
        axes.scatter(x, y, 90, "none", edgecolor="black", label=label, zorder=3)
    if len(values) <= MOST_TICKS:
        axes.xaxis.set_major_locator(ticker.FixedLocator(_ticks_apart(axes, values)))
        axes.xaxis.set_minor_locator(ticker.NullLocator())
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:.4g}"))
    across = names[0] if len(names) == 1 else "value of the parameter"
    lettering(axes, title=environment.environment, x=across + words, y=METRIC_WORDS[metric])
    is_there = any(np.isfinite(sweep.means.low).any() for sweep in sweeps.values())
    shared_legend(axes, n_bands=len(sweeps) if is_there else 0)


def _ticks_apart(axes: Axes, values: Floats) -> list[float]:
    """The values, in order, whose numbers do not touch on the x axis."""
    places = axes.xaxis.get_transform().transform(values)
    inches = (WIDTH - 1.3) * (places - places[0]) / ((places[-1] - places[0]) or 1.0)
    kept, end = [], -np.inf
    for value, place in zip(values.tolist(), inches, strict=True):
        half = width_of(f"{value:.4g}") / 2
        if place - half > end:
            kept.append(value)
            end = place + half + 0.08
    return kept


def _set_scale_of_values(axes: Axes, values: Floats) -> str:
    """Make the x axis logarithmic if values span two decades; return words for its label."""
    least = float(values[values > 0].min(initial=np.inf))
    if values.min() < 0 or values.max() < series.DWARFED * least:
        return ""
    if values.min() > 0:
        axes.set_xscale("log")
        return f" {LOG}"
    axes.set_xscale("symlog", linthresh=least)
    return f" (log scale beyond {number(least)})"


def draw_grid(
    axes: Axes, grid: series.Grid, title: str, environment: EnvironmentAnalysis, metric: str
) -> None:
    """The means over two swept parameters as a heat map, the best in frames."""
    shares = grid.shares(is_cost=metric in COSTS)  # the lighter the better
    colours = mpl.colormaps["viridis"](0.1 + 0.85 * shares)
    edges = (np.arange(-0.5, n) for n in grid.means.shape[::-1])
    axes.pcolormesh(*edges, colours, edgecolor="white", linewidth=1)
    best = with_best_mean(environment, *grid.labels)
    for (row, column), mean in np.ndenumerate(grid.means):
        if not np.isnan(mean):
            ink = "black" if shares[row, column] > 0.6 else "white"
            axes.text(column, row, number(mean), color=ink, ha="center", va="center", size=8)
        if grid.labels[row][column] in best:
            frame = Rectangle((column - 0.46, row - 0.44), 0.92, 0.88, fill=False, linewidth=2.5)
            frame.set_edgecolor(series.COLOURS[1])
            axes.add_patch(frame)
    axes.invert_yaxis()
    axes.grid(visible=False)
    turned = 90 if len(grid.across) > UPRIGHT else 0
    across, down = (  # in at most two lines
        [wrapped(v if len(v) <= LONGEST else f"{v[: LONGEST - 1]}…", 1.0) for v in values]
        for values in (grid.across, grid.down)
    )
    axes.set_xticks(range(len(across)), across, rotation=turned)
    axes.set_yticks(range(len(down)), down)
    axes.tick_params(length=0)
    y, x = grid.parameters
    frames = "a frame" if len(best) == 1 else "frames"
    title += f": {METRIC_WORDS[metric]}, means over seeds; the best mean in {frames}"
    lettering(axes, title=title, x=x, y=y, beside=1.8)


# The lines of more agents are unreadable; a sweep shows its agents by parameter instead.
MOST_LINES = 14


def write_figures(shown: StudySeries) -> list[Path]:
    """Draw all figures that a study's runs allow into its folder ``figures``; return the files."""
    analysis, marks = shown.analysis, shown.marks
    files = FigureFiles(analysis.results.root / "figures", analysis.study.figures)
    files.folder.mkdir(exist_ok=True)
    for one in shown.environments:
        if one.pulls is not None:
            _bandit_figures(files, one.pulls, one.environment.environment, marks)
    for one in shown.environments:
        _study_figures(files, one, analysis.study, marks)
    if (overall := analysis.overall) is not None:
        with files.figure("performance_profiles") as (axes,):
            for agent, shares in overall.profiles.items():
                style = line_style(marks[agent])
                axes.plot(overall.thresholds, shares, label=agent, linewidth=1.5, **style)
            axes.set_ylim(0, 1.02)
            axes.yaxis.set_major_formatter(ticker.PercentFormatter(1))
            title = "Performance profiles over environments"
            lettering(axes, title=title, x="score", y="share of runs with a higher score")
            shared_legend(axes)
    return files.written


def _study_figures(
    files: FigureFiles, one: EnvironmentSeries, study: StudySpec, marks: Marks
) -> None:
    environment, metric = one.environment, study.metric
    name = file_name(environment.environment)
    if one.sweeps:
        with files.figure(f"{name}_sweep") as (axes,):
            draw_sweeps(axes, one, metric)
    for group, grid in one.grids.items():
        title = environment.environment + (f", {group}" if len(one.grids) > 1 else "")
        height = 1.6 + 0.4 * len(grid.down)
        with files.figure(f"{name}_{file_name(group)}_grid", height=height) as (axes,):
            draw_grid(axes, grid, title, environment, metric)
    if len(environment.agents) > MOST_LINES or one.curves is None:
        return
    if n_columns := len(panels(one.curves)):
        with files.figure(f"{name}_learning_curves", n_columns) as places:
            draw_learning_curves(places, one, marks)
    with files.figure(f"{name}_intervals") as (axes,):
        draw_runs(axes, one, study, marks)


def _bandit_figures(files: FigureFiles, pulls: PullSeries, place: str, marks: Marks) -> None:
    name = file_name(place)
    if len(pulls.pulls) <= MOST_LINES:
        with files.figure(f"{name}_pulls", n_rows=2) as (upper, lower):
            draw_rewards(upper, lower, pulls, place, marks)
        has_simple = any(np.isfinite(p.simple_regret).any() for p in pulls.pulls.values())
        with files.figure(f"{name}_regret", n_rows=1 + has_simple) as places:
            draw_regret(places, pulls, place, marks)
    if pulls.arms is not None and len(pulls.arms.shares) <= MOST_LINES:
        with files.figure(f"{name}_arms", n_rows=2) as (upper, lower):
            draw_arms(upper, lower, pulls.arms, marks)
    for belief in pulls.beliefs:
        n_moments, n_contexts = belief.densities.shape[:2]
        n_columns = 2 if n_moments % 2 == 0 else 1
        n_rows = n_moments * n_contexts // n_columns
        path = f"{name}_{file_name(belief.agent)}_posteriors"
        with files.figure(path, n_columns, n_rows, height=2.2) as places:
            draw_belief(places, belief)
