"""Draws pictures of a run: its learning curve and its pulls."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.run import LAST_PULLS
from rl_yardstick.safe_files.files import NO_LIMIT, content_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rl_yardstick.pipeline.evaluation.yardstick import Yardstick


def fix_layout(figure: Figure) -> None:
    """Compute the layout now; artists that are added later do not change it."""
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine("none")


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure with a fixed layout; `Figure.savefig` would draw everything twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

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
MOST_POWERS = 12  # powers of ten on an axis
# From this ratio on, the largest values flatten the rest of a linear axis: two decades.
DWARFED = 100


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


def symlog_ticks(linear_up_to: float) -> list[float]:
    """Ticks of a symmetric logarithmic axis: 0, one in the linear part, two for each power."""
    power = math.floor(math.log10(linear_up_to))
    within = max(m for m in (1, 2, 5) if m * 10.0**power <= linear_up_to) * 10.0**power
    beyond = [m * 10.0**k for k in range(power, power + MOST_POWERS) for m in (1, 3)]
    sizes = [within, *(size for size in beyond if size > linear_up_to)]
    return [-size for size in reversed(sizes)] + [0.0, *sizes]


def _compress_outliers(axes: Axes, returns: Floats) -> None:
    """Use a symmetric logarithmic axis if early returns are far larger than the last ones."""
    from matplotlib.ticker import FixedLocator, StrMethodFormatter

    if not len(returns):
        return
    settled = max(float(np.abs(returns[-len(returns) // 4 :]).max()), 1.0)
    if np.abs(returns).max() >= DWARFED * settled:
        axes.set_yscale("symlog", linthresh=settled)
        axes.yaxis.set_major_locator(FixedLocator(symlog_ticks(settled)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.set_ylabel(f"{axes.get_ylabel()}\n(log beyond ±{settled:,.0f})")


def _draw_training(axes: Axes, steps: Floats, returns: Floats, what: str) -> None:
    if not len(steps):
        return
    n_averaged = min(MOVING_AVERAGE_EPISODES, len(returns))
    smooth = moving_average(returns, n_averaged)
    stride = max(len(steps) // MAX_POINTS, 1)
    axes.plot(
        steps[::stride],
        returns[::stride],
        ".",
        color=GREY,
        markersize=2,
        alpha=0.4,
        label=f"{what}, " + ("each episode" if stride == 1 else f"1 episode in {stride}"),
    )
    if n_averaged > 1:
        label = f"{what}, mean of {n_averaged} episodes"
        axes.plot(steps[::stride], smooth[::stride], color=ORANGE, label=label)


def _draw_yardstick(axes: Axes, yardstick: Yardstick) -> None:
    least = yardstick.at_least
    most = "optimum, at most" if yardstick.is_proven else "optimum, at most (not proven)"
    lines = [("optimum" if least is None else most, yardstick.optimum, "-")]
    if least is not None:
        lines.append(("optimum, at least", least, "--"))
    lines.append(("best random or constant policy", yardstick.baseline, ":"))
    for label, height, style in lines:
        axes.axhline(height, color=GREEN, linestyle=style, linewidth=1.2, label=label, zorder=1)


def _places(figure: Figure, *, apart: bool) -> tuple[Axes, Axes]:
    """Axes for evaluations and for training: shared, or one above the other."""
    if not apart:
        axes = figure.subplots()
        axes.set(xlabel="environment steps", ylabel="return of an episode")
        return axes, axes
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    upper.set_ylabel("return of an episode")
    lower.set(xlabel="environment steps", ylabel="training return")
    lower.set_title("training, on a variant of the environment", loc="left", fontsize=10)
    return upper, lower


def draw_learning_curve(
    folder: Path,
    title: str,
    first_step: int = 0,
    yardstick: Yardstick | None = None,
    *,
    on_variant: bool = False,
) -> None:
    """Draw training returns, from ``first_step`` on, and evaluations into the run folder."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    steps, returns = read_monitors(folder)
    evaluated_at = means = np.empty(0)
    if (folder / "evaluations.npz").exists():
        with np.load(folder / "evaluations.npz") as arrays:
            evaluated_at, means = arrays["timesteps"], arrays["results"].mean(axis=1)
    has_judgement = len(means) > 0 or yardstick is not None
    apart = on_variant and len(steps) > 0 and has_judgement
    judged, trained = _places(figure, apart=apart)
    what = "training on a variant" if on_variant and not apart else "training"
    _draw_training(trained, steps + first_step, returns, what)
    if len(means):
        label = "evaluation, mean return"
        judged.plot(evaluated_at, means, "o-", color=BLUE, markersize=4, label=label)
    if yardstick is not None:
        _draw_yardstick(judged, yardstick)
    _compress_outliers(trained, returns)
    if apart:
        _compress_outliers(judged, means)
    judged.set_title(title, loc="left")
    for axes in dict.fromkeys((judged, trained)):
        _style(axes)
    if any(axes.get_legend_handles_labels()[0] for axes in (judged, trained)):
        # Below the axes, where the legend covers no points.
        legend = figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9)
        for handle in legend.legend_handles:
            if isinstance(handle, Line2D) and handle.get_color() == GREY:
                handle.set(markersize=6, alpha=1)  # a dot of the drawn size is hard to see
    fix_layout(figure)
    write_png(figure, folder / "learning_curve.png")


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

# The columns of ``diagnosis.csv`` in each panel, by the panel's axis label.
PANELS = {
    "error of values": ("v_error", "v_error_visited", "q_error", "q_error_visited"),
    "error of advantages": ("advantage_error", "advantage_error_visited"),
    "overestimation": ("overestimation",),
    "error of GAE": ("gae_bias", "gae_offset", "gae_std"),
    "cosine with the exact gradient": ("gradient_cosine",),
    "signal-to-noise ratio of the gradient": ("gradient_snr",),
    "entropy in nats": ("entropy",),
}
VISITED = ("state", "visits")
LINES = {"bias": "bias between actions", "offset": "bias of the state", "std": "std"}


def read_diagnosis(content: bytes) -> dict[str, Floats]:
    """The columns of a ``diagnosis.csv``, NaN for empty cells."""
    names, *rows = csv.reader(content.decode().splitlines())
    table = [[float(cell or "nan") for cell in row] for row in rows]
    return dict(zip(names, np.array(table).T, strict=True))


def draw_diagnosis(folder: Path, title: str) -> None:
    """Draw the errors of values, advantages and gradients during training."""
    from matplotlib.figure import Figure

    found = read_diagnosis((folder / "diagnosis.csv").read_bytes())
    panels = {word: [n for n in names if n in found] for word, names in PANELS.items()}
    panels = {word: names for word, names in panels.items() if names}
    n_rows = -(-len(panels) // 3)
    figure = Figure(figsize=(12, 3.4 * n_rows), dpi=100, layout="constrained")
    places = figure.subplots(n_rows, 3, squeeze=False).ravel()
    for axes in places[len(panels) :]:
        axes.remove()
    for axes, (word, names) in zip(places, panels.items(), strict=False):
        for name, colour in zip(names, (BLUE, ORANGE, GREEN, GREY), strict=False):
            kind, _, end = name.partition("_")
            label = LINES.get(end) or f"{kind[:1].upper()}, by {VISITED[end.endswith('visited')]}"
            axes.plot(found["timesteps"], found[name], ".-", color=colour, label=label)
        axes.set(xlabel="environment steps", ylabel=word)
        if len(names) > 1:
            axes.legend(frameon=False, fontsize=9)
        _style(axes)
    figure.suptitle(title, x=0.01, ha="left")
    fix_layout(figure)
    write_png(figure, folder / "diagnosis.png")


def draw_pulls(path: Path, title: str, pulls: Mapping[str, NDArray[Any]]) -> None:
    """Draw reward, share of a best arm and regret by pull; see `PullLog.arrays`."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    # A pull that is not in the log has no reward.
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
        axes.set_xlabel("pulls" if kept.all() else "pulls in the log")
        _style(axes)
    figure.suptitle(title, x=0.01, ha="left")
    fix_layout(figure)
    write_png(figure, path)


def _draw(axes: Axes, values: Floats, colour: str) -> None:
    shown = np.unique(np.linspace(0, len(values) - 1, MAX_POINTS).round().astype(np.int64))
    axes.plot(shown + 1, values[shown], color=colour)
