"""Figures of bandits, in the forms that the textbooks have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import PercentFormatter

from mdp.array_types import Floats, Ints
from report.figures.figure_style import (
    LOG,
    MOST_BANDS,
    REFERENCE,
    colour_of,
    label_ends,
    lettering,
    line_style,
    shared_legend,
)
from report.series.agent_marks import COLOURS, Mark
from report.series.posteriors import Belief
from report.series.pull_series import (
    SPREAD,
    ArmSeries,
    PullSeries,
    mean_regret,
    regret_of_runs,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Marks = Mapping[str, Mark]
Line = tuple[str, Ints, Floats, Mapping[str, str]]  # name, x, y, style

_PULLS = f"pulls {LOG}"
UPRIGHT = 6  # arms whose names have room side by side


def draw_rewards(upper: Axes, lower: Axes, series: PullSeries, place: str, marks: Marks) -> None:
    """Average reward and share of optimal arms by pull: figure 2.2 of Sutton and Barto."""
    found = series.pulls.items()
    rewards: list[Line] = [(a, p.pulls, p.reward, line_style(marks[a])) for a, p in found]
    if series.best is not None:
        pulls = rewards[0][1][[0, -1]]
        style = {"color": REFERENCE, "linestyle": "-"}
        rewards.append(("best possible", pulls, np.full(2, series.best), style))
    _draw_lines(upper, rewards)
    lettering(upper, title=f"{place}, {series.n_runs:,} runs", x="pulls", y="average reward")
    lower.set_ylim(0, 1)
    _draw_lines(lower, [(a, p.pulls, p.optimal, line_style(marks[a])) for a, p in found])
    lower.yaxis.set_major_formatter(PercentFormatter(1))
    lettering(lower, x="pulls", y="runs that pull a best arm")


def _draw_lines(axes: Axes, lines: Sequence[Line]) -> None:
    """Lines with their names at their ends."""
    for name, x, y, style in lines:
        axes.plot(x, y, label=name, linewidth=1, **style)  # type: ignore[arg-type]
    label_ends(axes, [(name, x[-1], y[-1], style["color"]) for name, x, y, style in lines])


def draw_regret(axes: Axes, series: PullSeries, place: str, marks: Marks) -> None:
    """Cumulative regret on a logarithmic axis of pulls, with what theory says of it."""
    axes.set_xscale("log")
    lines: list[Line] = []
    # The interval of the mean, then the spread of runs, as far as the bands are few.
    kinds = ((mean_regret, 0.3), (regret_of_runs, 0.08))[: MOST_BANDS // len(series.pulls)]
    for agent, pulls in series.pulls.items():
        style = line_style(marks[agent])
        lines.append((agent, pulls.pulls, mean_regret(pulls).y, style))
        for curve_of, alpha in kinds:
            band = curve_of(pulls)
            axes.fill_between(
                band.x, band.low, band.high, color=style["color"], alpha=alpha, linewidth=0
            )
    words = ("", " with its 95 % interval", f", its 95 % interval, and {SPREAD} of the runs")
    title = f"{place}: mean of {series.n_runs:,} runs{words[len(kinds)]}"
    highest = max(axes.dataLim.y1, *(np.nanmax(y) for _, _, y, _ in lines))
    if series.bounds is not None:
        # A bound far above is cut; and one that never learns leaves the others some height.
        bounds, shown = series.bounds, series.bounds.auer <= 1.5 * highest
        for name, x, y, dash in (
            ("Auer's bound for UCB1", bounds.pulls[shown], bounds.auer[shown], "--"),
            ("Lai-Robbins slope", bounds.pulls, bounds.lai_robbins, ":"),
        ):
            lines.append((name, x, y, {"color": REFERENCE, "linestyle": dash}))
        highest = min(highest, float(bounds.auer[-1]))
    axes.set_ylim(0, 1.05 * highest)
    _draw_lines(axes, lines)
    lettering(axes, title=title, x=_PULLS, y="cumulative regret")


def draw_simple_regret(axes: Axes, series: PullSeries, marks: Marks) -> None:
    """What recommending the arm pulled most so far falls short of the best one by."""
    axes.set_xscale("log")
    found = series.pulls.items()
    known = [(a, p) for a, p in found if np.isfinite(p.simple_regret).any()]
    _draw_lines(axes, [(a, p.pulls, p.simple_regret, line_style(marks[a])) for a, p in known])
    title = "of recommending the arm pulled most"
    lettering(axes, title=title, x=_PULLS, y="simple regret")


def draw_arms(upper: Axes, lower: Axes, arms: ArmSeries, marks: Marks) -> None:
    """By context, how often each arm was pulled, and what its mean was taken for."""
    places = np.arange(len(arms.names))
    width = 0.8 / len(arms.shares)
    for index, (agent, shares) in enumerate(arms.shares.items()):
        colour = colour_of(marks[agent])
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
    upper.yaxis.set_major_formatter(PercentFormatter(1))
    lettering(upper, title="pulls, by context", y="share of the pulls")
    title = "final estimates, mean and spread over runs; lines across are the truth"
    lettering(lower, title=title, y="mean reward")
    shared_legend(upper)


def draw_belief(panels: Sequence[Axes], belief: Belief) -> None:
    """What an agent believed of each arm in its first run, panels of moments for each context."""
    n_moments, n_contexts, n_arms, _ = belief.densities.shape
    for panel, axes in enumerate(panels):
        context, moment = divmod(panel, n_moments)
        for arm in range(n_arms):
            colour = COLOURS[arm % len(COLOURS)]
            y = belief.densities[moment, context, arm]
            axes.plot(belief.points, y, linewidth=1.2, label=f"arm {arm}", color=colour)
            mean = belief.true_means[context][arm]
            if mean is not None:
                axes.axvline(mean, color=colour, linestyle=":", linewidth=1)
        where = f", context {context}" if n_contexts > 1 else ""
        title = f"{belief.agent}{where}, after {belief.moments[moment]:,} pulls"
        lettering(axes, title=title, x="mean reward", y="density")
    panels[0].legend(frameon=False)
