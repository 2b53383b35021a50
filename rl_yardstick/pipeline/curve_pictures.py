"""Draws the learning curve of a run, and reads its diagnosis."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.safe_files.files import NO_LIMIT, content_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rl_yardstick.pipeline.evaluation.yardstick import Yardstick


def fix_layout(figure: Figure) -> None:
    """Compute the layout now; artists that are added later do not change it."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure with its layout fixed; `Figure.savefig` would draw everything twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    fix_layout(figure)
    canvas: Any = FigureCanvasAgg(figure)
    with replacing(path) as beside:
        canvas.print_png(beside)


# Okabe and Ito's colours, which colour-blind readers can distinguish.
BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
GREY = "#9A9A9A"

MOVING_AVERAGE_EPISODES = 100
MAX_POINTS = 5000


def read_monitors(folder: Path) -> tuple[Floats, Floats]:
    """For each training episode, its last step counted over all environments, and its return."""
    contents = [content_of(path, NO_LIMIT) for path in sorted(folder.glob("*.monitor.csv"))]
    rows = [
        np.loadtxt(BytesIO(content), delimiter=",", skiprows=2, usecols=(0, 1), ndmin=2)
        for content in contents
        if content.count(b"\n") > 2
    ]
    if not rows:
        return np.empty(0), np.empty(0)
    # The environments step together, so all have done the same number of steps.
    steps = np.concatenate([len(contents) * np.cumsum(table[:, 1]) for table in rows])
    returns = np.concatenate([table[:, 0] for table in rows])
    order = np.argsort(steps, kind="stable")
    return steps[order], returns[order]


def moving_average(values: Floats, width: int) -> Floats:
    """Mean of the last ``width`` values at each position, or of fewer at the beginning."""
    sums = np.cumsum(np.insert(values, 0, 0.0))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - width, 0)
    return np.asarray((sums[ends] - sums[starts]) / (ends - starts))


def draw_learning_curve(
    folder: Path,
    title: str,
    evaluations: Mapping[int, float],
    first_step: int,
    yardstick: Yardstick | None,
    *,
    on_variant: bool,
) -> None:
    """Draw training returns, from ``first_step`` on, and evaluations by steps into a folder."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    steps, returns = read_monitors(folder)
    # Returns of a variant of the environment have a scale of their own.
    apart = on_variant and len(steps) > 0 and (len(evaluations) > 0 or yardstick is not None)
    ratios = (3, 2) if apart else (1,)
    panels = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)
    judged, trained = panels[0, 0], panels[-1, 0]
    judged.set_ylabel("return of an episode")
    trained.set_xlabel("environment steps")
    if apart:
        trained.set_ylabel("training return")
        trained.set_title("training, on a variant of the environment", loc="left", fontsize=10)
    if len(steps):
        what = "training on a variant" if on_variant and not apart else "training"
        _draw_training(trained, steps + first_step, returns, what)
    if evaluations:
        style: Any = {"color": BLUE, "markersize": 4, "label": "evaluation, mean return"}
        judged.plot(list(evaluations), list(evaluations.values()), "o-", **style)
    if yardstick is not None:
        most = "optimum, at most" if yardstick.is_proven else "optimum, at most (not proven)"
        ends: dict[str, tuple[float | None, str]] = {
            "optimum" if yardstick.at_least is None else most: (yardstick.optimum, "-"),
            "optimum, at least": (yardstick.at_least, "--"),
            "best random or constant policy": (yardstick.baseline, ":"),
        }
        for label, (height, dash) in ends.items():
            if height is not None:
                judged.axhline(height, color=GREEN, linestyle=dash, linewidth=1.2, label=label)
    judged.set_title(title, loc="left")
    for axes in panels.flat:
        _style(axes)
    # Below the axes, where the legend covers no points.
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9, markerscale=2)
    write_png(figure, folder / "learning_curve.png")


def _draw_training(axes: Axes, steps: Floats, returns: Floats, what: str) -> None:
    stride = max(len(steps) // MAX_POINTS, 1)
    label = f"{what}, " + ("each episode" if stride == 1 else f"1 episode in {stride}")
    style: Any = {"color": GREY, "markersize": 3, "markeredgewidth": 0, "label": label}
    axes.plot(steps[::stride], returns[::stride], "o", **style)
    if (width := min(MOVING_AVERAGE_EPISODES, len(returns))) > 1:
        smooth, label = moving_average(returns, width), f"{what}, mean of {width} episodes"
        axes.plot(steps[::stride], smooth[::stride], color=ORANGE, label=label)


def _style(axes: Axes) -> None:
    from matplotlib.ticker import EngFormatter

    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


# The columns of ``diagnosis.csv`` after the first, in their order.
MEANINGS = {
    "v_error": "error of V, RMS over states",
    "v_error_visited": "error of V, RMS over visits",
    "q_error": "error of Q, RMS over states",
    "q_error_visited": "error of Q, RMS over visits",
    "advantage_error": "error of advantages, RMS over states",
    "advantage_error_visited": "error of advantages, RMS over visits",
    "overestimation": "max Q less true value, mean over visits",
    "entropy": "entropy of the policy, nats, mean over visits",
    "gae_bias": "GAE: bias between actions, RMS",
    "gae_offset": "GAE: bias of the state, RMS",
    "gae_std": "GAE: standard deviation",
    "gradient_cosine": "gradient: cosine with the exact one",
    "gradient_snr": "gradient: signal-to-noise ratio",
}


def read_diagnosis(content: bytes) -> dict[str, Floats]:
    """The columns of a ``diagnosis.csv``, NaN for empty cells."""
    names, *rows = csv.reader(content.decode().splitlines())
    table = [[float(cell or "nan") for cell in row] for row in rows]
    return dict(zip(names, np.array(table).T, strict=True))
