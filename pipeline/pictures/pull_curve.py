"""The picture of a training on a bandit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Floats
from pipeline.pictures.learning_curve import BLUE, GREEN, MAX_POINTS, ORANGE, moving_average
from pipeline.pictures.picture_files import fix_layout, write_png
from pipeline.pull_recording import LAST_PULLS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_pulls(path: Path, title: str, pulls: Mapping[str, NDArray[Any]]) -> None:
    """Draw average reward, share of a best arm and cumulative regret by pull.

    Args:
        path: the picture, as PNG.
        title: what stands above it.
        pulls: arrays as `agents.bandits.pull_log.PullLog.arrays` gives them, of shape
            (n_envs, pulls); drawn in the order in which they were pulled.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, PercentFormatter

    # A pull that a log does not hold has no reward.
    kept = pulls["matched"].T.ravel()
    rewards, regrets = (pulls[name].T.ravel()[kept] for name in ("rewards", "regrets"))
    if not len(rewards):
        return
    is_known = not np.isnan(regrets).any()
    figure = Figure(figsize=(12 if is_known else 5, 4), dpi=120, layout="constrained")
    panels = figure.subplots(1, 3 if is_known else 1, squeeze=False)[0]
    _draw(panels[0], moving_average(rewards.astype(np.float64), LAST_PULLS), BLUE)
    panels[0].set(ylabel=f"reward, mean of {LAST_PULLS} pulls")
    if is_known:
        optimal = (regrets == 0.0).astype(np.float64)
        _draw(panels[1], moving_average(optimal, LAST_PULLS), GREEN)
        panels[1].set(ylabel=f"best arm, share of {LAST_PULLS} pulls", ylim=(0, 1.02))
        panels[1].yaxis.set_major_formatter(PercentFormatter(1))
        _draw(panels[2], np.cumsum(regrets), ORANGE)
        panels[2].set(ylabel="cumulative regret")
    for axes in panels:
        axes.set_xlabel("pulls" if kept.all() else "pulls that the log holds")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, x=0.01, ha="left")
    fix_layout(figure)
    write_png(figure, path)


def _draw(axes: Axes, values: Floats, colour: str) -> None:
    shown = np.unique(np.linspace(0, len(values) - 1, MAX_POINTS).round().astype(np.int64))
    axes.plot(shown + 1, values[shown], color=colour)
