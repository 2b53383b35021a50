"""Pictures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mdp.array_types import Floats
from pipeline.evaluation.sampled import Yardstick
from pipeline.files import replacing
from pipeline.run_folder import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, told apart by colour-blind readers too.
BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
GREY = "#9A9A9A"

MOVING_AVERAGE_EPISODES = 100
MAX_POINTS = 5000


def read_monitors(folder: Path) -> tuple[Floats, Floats]:
    """Training episodes of a run in the order in which they ended.

    Args:
        folder: the run folder, with one ``*.monitor.csv`` for each environment.

    Returns:
        Environment steps done by the end of each episode, counted over all environments, and its
        return, both of shape (n_episodes,).
    """
    paths = sorted(folder.glob("*.monitor.csv"))
    rows = [
        np.loadtxt(path, delimiter=",", skiprows=2, usecols=(0, 1), ndmin=2)
        for path in paths
        if path.read_bytes().count(b"\n") > 2
    ]
    if not rows:
        return np.empty(0), np.empty(0)
    # The environments of a run are stepped together: by the time that one of them has done so many
    # steps, all of them have.
    steps = np.concatenate([len(paths) * np.cumsum(table[:, 1]) for table in rows])
    returns = np.concatenate([table[:, 0] for table in rows])
    order = np.argsort(steps, kind="stable")
    return steps[order], returns[order]


def moving_average(values: Floats, width: int) -> Floats:
    """Mean of the last ``width`` values at each position, or of as many as there are."""
    sums = np.cumsum(np.insert(values, 0, 0.0))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - width, 0)
    return np.asarray((sums[ends] - sums[starts]) / (ends - starts))


def _compress_outliers(axes: Axes, returns: Floats) -> None:
    """Use a symmetric logarithmic axis where early returns dwarf those at the end."""
    if not len(returns):
        return
    settled = np.abs(returns[-len(returns) // 4 :]).max()
    if np.abs(returns).max() > 10 * max(settled, 1.0):
        axes.set_yscale("symlog", linthresh=max(settled, 1.0))


def _draw_evaluations(axes: Axes, run: Run) -> None:
    if not run.evaluations_path.exists():
        return
    with np.load(run.evaluations_path) as evaluations:
        axes.plot(
            evaluations["timesteps"],
            evaluations["results"].mean(axis=1),
            "o-",
            color=BLUE,
            markersize=4,
            label="evaluation, mean return",
        )


def _draw_yardstick(axes: Axes, yardstick: Yardstick) -> None:
    lines = (("optimum", yardstick.optimum, "-"), ("best blind policy", yardstick.blind, ":"))
    for label, height, style in lines:
        axes.axhline(height, color=GREEN, linestyle=style, linewidth=1.2, label=label, zorder=1)


def draw_learning_curve(
    run: Run, title: str, first_step: int = 0, yardstick: Yardstick | None = None
) -> None:
    """Draw training and evaluation returns by environment steps into the run folder.

    Args:
        run: the run.
        title: what stands above the picture.
        first_step: environment steps that the agent had behind it when the run began.
        yardstick: the returns to measure against, where they are known.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    axes = figure.subplots()
    steps, returns = read_monitors(run.path)
    steps = steps + first_step
    if len(steps):
        smooth = moving_average(returns, MOVING_AVERAGE_EPISODES)
        stride = max(len(steps) // MAX_POINTS, 1)
        axes.plot(steps[::stride], returns[::stride], ".", color=GREY, markersize=2, alpha=0.4)
        axes.plot(
            steps[::stride],
            smooth[::stride],
            color=ORANGE,
            label=f"training, mean of {MOVING_AVERAGE_EPISODES} episodes",
        )
    _draw_evaluations(axes, run)
    if yardstick is not None:
        _draw_yardstick(axes, yardstick)
    _compress_outliers(axes, returns)
    axes.set(xlabel="environment steps", ylabel="return of an episode")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_title(title, loc="left")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        # Outside, where it covers no episode.
        figure.legend(loc="outside lower left", ncols=4, frameon=False, fontsize=9)
    with replacing(run.curve_path) as draft:
        figure.savefig(draft, format="png")
