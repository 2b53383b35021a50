"""Figures of bandits, in the forms that the textbooks have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import PercentFormatter

from report.figures.figure_style import REFERENCE, colour_of, line_style, shared_legend
from report.series.agent_marks import COLOURS, Mark
from report.series.posteriors import Belief
from report.series.pull_series import (
    SPREAD,
    ArmSeries,
    PullSeries,
    RegretBounds,
    mean_regret,
    regret_of_runs,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Marks = Mapping[str, Mark]


def draw_rewards(left: Axes, right: Axes, series: PullSeries, place: str, marks: Marks) -> None:
    """Average reward and share of optimal arms by pull: figure 2.2 of Sutton and Barto."""
    for agent, pulls in series.pulls.items():
        style = line_style(marks[agent])
        left.plot(pulls.pulls, pulls.reward, linewidth=1, label=agent, **style)
        right.plot(pulls.pulls, pulls.optimal, linewidth=1, **style)
    if series.best is not None:
        left.axhline(series.best, color=REFERENCE, linewidth=1, label="best possible")
    left.set(xlabel="pulls", ylabel="average reward")
    right.set(xlabel="pulls", ylabel="runs that pull a best arm", ylim=(0, 1))
    right.yaxis.set_major_formatter(PercentFormatter(1))
    left.set_title(f"{place}, {series.n_runs:,} runs", loc="left")
    shared_legend(left)


def draw_regret(axes: Axes, series: PullSeries, place: str, marks: Marks) -> None:
    """Cumulative regret on a logarithmic axis of pulls, with what theory says of it."""
    for agent, pulls in series.pulls.items():
        style = line_style(marks[agent])
        mean, runs = mean_regret(pulls), regret_of_runs(pulls)
        axes.plot(mean.x, mean.y, linewidth=1.5, label=agent, **style)
        for curve, alpha in ((mean, 0.3), (runs, 0.08)):
            axes.fill_between(
                curve.x, curve.low, curve.high, color=style["color"], alpha=alpha, linewidth=0
            )
    if series.bounds is not None:
        _draw_bounds(axes, series.bounds)
    axes.set(xscale="log", xlabel="pulls", ylabel="cumulative regret")
    axes.set_title(f"{place}: mean, 95 % interval, {SPREAD} of runs", loc="left")
    shared_legend(axes)


def _draw_bounds(axes: Axes, bounds: RegretBounds) -> None:
    ceiling = axes.get_ylim()[1]
    shown = bounds.auer <= 1.5 * ceiling
    for x, y, style, label in (
        (bounds.pulls[shown], bounds.auer[shown], "--", "Auer, for UCB1"),
        (bounds.pulls, bounds.lai_robbins, ":", "Lai-Robbins slope"),
    ):
        axes.plot(x, y, color=REFERENCE, linestyle=style, linewidth=1, label=label)
    # An agent that never learns would leave no height for the others.
    axes.set_ylim(0, min(ceiling, 1.1 * bounds.auer[-1]))


def draw_simple_regret(axes: Axes, series: PullSeries, marks: Marks) -> None:
    """What recommending the arm pulled most so far falls short of the best one by."""
    for agent, pulls in series.pulls.items():
        axes.plot(pulls.pulls, pulls.simple_regret, linewidth=1.5, **line_style(marks[agent]))
    axes.set(xscale="log", xlabel="pulls", ylabel="simple regret")
    axes.set_title("of recommending the arm pulled most", loc="left")


def draw_arms(left: Axes, right: Axes, arms: ArmSeries, marks: Marks) -> None:
    """By context, how often each arm was pulled, and what its mean was taken for."""
    places = np.arange(len(arms.names))
    width = 0.8 / len(arms.shares)
    for index, (agent, shares) in enumerate(arms.shares.items()):
        colour = colour_of(marks[agent])
        offset = places + (index - (len(arms.shares) - 1) / 2) * width
        left.bar(offset, shares, width, color=colour, label=agent)
        if agent in arms.estimates:
            mean, std = arms.estimates[agent]
            right.errorbar(offset, mean, std, fmt="o", markersize=3, linewidth=1, color=colour)
    right.plot(places, arms.means, "_", color="black", markersize=30, zorder=3)
    for axes in (left, right):
        axes.set_xticks(places, [name.replace(", ", "\n") for name in arms.names])
    left.set(ylabel="share of the pulls", ylim=(0, 1))
    left.yaxis.set_major_formatter(PercentFormatter(1))
    left.set_title("pulls, by context", loc="left")
    right.set(ylabel="mean reward")
    right.set_title("final estimates, mean and spread over runs; bars are the truth", loc="left")
    shared_legend(left)


def draw_belief(panels: Sequence[Axes], belief: Belief) -> None:
    """What an agent believed of each arm in its first run, a row of panels for each context."""
    n_moments, n_contexts, n_arms, _ = belief.densities.shape
    for panel, axes in enumerate(panels):
        context, moment = divmod(panel, n_moments)
        for arm in range(n_arms):
            colour = COLOURS[arm % len(COLOURS)]
            y = belief.densities[moment, context, arm]
            axes.plot(belief.points, y, linewidth=1.5, label=f"arm {arm}", color=colour)
            mean = belief.true_means[context][arm]
            if mean is not None:
                axes.axvline(mean, color=colour, linestyle=":", linewidth=1)
        axes.set(xlabel="mean reward", ylabel="density")
        where = f", context {context}" if n_contexts > 1 else ""
        moment_words = f"after {belief.moments[moment]:,} pulls"
        axes.set_title(f"{belief.agent}{where}, {moment_words}", loc="left")
    panels[0].legend(frameon=False)
