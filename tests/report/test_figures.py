"""What figures show, asked of Matplotlib's axes: numbers, colours, words; and nothing is cut."""

from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection, PathCollection, PolyCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.ticker import EngFormatter, FixedLocator, PercentFormatter

from rl_yardstick.experiments.analysis import OverallAnalysis
from rl_yardstick.report import series
from rl_yardstick.report.figures import write_figures
from tests.report import made_up

GREY = "#595959"
NAMED = {**dict(zip(series.COLOURS, ("blue", "red", "green"), strict=False)), GREY: "grey"}
THIRD = np.array([0.0, 0.5, 1.0])
PULLS = np.array([1, 10, 100])
BOUNDS = series.RegretBounds(PULLS, np.array([10.0, 30.0, 90.0]), np.array([0.0, 5.0, 10.0]))


def curve(x, y):
    x, y = np.array(x, dtype=float), np.array(y, dtype=float)
    return series.Curve(x, y, y - 1, y + 2)


def curves_of(names, linear_up_to=None, on_variant=()):
    """Of each agent 40 less than of the one before; of the second one point of training."""
    steps = {name: curve([10, 20, 30], [5, 50 - 40 * n, 90]) for n, name in enumerate(names)}
    episodes = {name: curve([1, 2][n == 1 :], [7, 8][n == 1 :]) for n, name in enumerate(names)}
    nothing = {names[0]: curve([1, 2], [-1, -2])}  # on an axis that is not drawn
    return {
        "evaluation": series.LearningCurves({"step": steps, "episode": nothing}, linear_up_to),
        "training": series.LearningCurves({"step": nothing, "episode": episodes}, None, on_variant),
    }


def runs_of(names):
    """Of the second agent one run has no figure."""
    some = {0: [85.0, 90, 95], 1: [40.0, np.nan]}
    return {name: np.array(some.get(n, [1.0])) for n, name in enumerate(names)}


def whole_study(root, names, label, linear_up_to=None, on_variant=()):
    """A study that has every kind of figure; its agents rank in the order of their names."""
    agents = tuple(made_up.agent(name, 90.0 - 50 * n) for n, name in enumerate(names))
    lake = made_up.environment(agents, label, values=runs_of(names))
    coins = made_up.environment(agents, "coins")
    first, second = names[:2]
    swept = {
        first: series.Sweep("α", curve([0.01, 0.1, 0.9], [30, 90, 3]), (second, first, "-")),
        second: series.Sweep("γ", curve([0.9, 0.95, 1], [1, 2, 3]), ("-", "-", "-")),
    }
    means = np.array([[90.0, 30.0], [40.0, np.nan]])
    cells = [[first, "-"], [second, ""]]
    grid = series.Grid(("γ", "kind"), ["1", "2"], names[:2], means, cells)
    arms = series.ArmSeries(
        [f"context {context}, arm {arm}" for context in (0, 1) for arm in (0, 1)],
        np.array([0.1, 0.2, 0.3, 0.4]),
        {name: np.array([0.25, 0.75, 0.5, 0.5]) for name in names},
        {names[1]: (np.array([0.1, 0.3, 0.2, 0.5]), np.array([0.01, 0.02, 0.03, 0.04]))},
    )
    # The densities count up: by context, arm and point.
    densities = np.arange(12.0).reshape(1, 2, 2, 3)
    true_means = [[0.25, 0.75], [None, 0.5]]
    belief = series.Belief(names[1], np.array([2000]), THIRD, densities, true_means)
    pulls = {name: made_up.pulls(10.0 + 40 * n) for n, name in enumerate(names)}
    of_coins = series.PullSeries(pulls, 75.0, BOUNDS, arms, (belief,))
    profiles = dict.fromkeys(names, 1 - THIRD)
    overall = OverallAnalysis({}, (), None, THIRD, profiles)
    learnt = curves_of(names, linear_up_to, on_variant)
    places = (
        series.EnvironmentSeries(lake, learnt, None, swept, {"swept": grid}),
        series.EnvironmentSeries(coins, None, of_coins, {}),
    )
    found = made_up.analysis([lake, coins], names[::-1], root, overall=overall)
    return series.StudySeries(found, series.agent_marks(found.study), places)


@pytest.fixture
def drawn(monkeypatch):
    """Figures with all in its place, as they were written; of fewer points, which is faster."""
    found = []

    def draw(canvas, file, **_):
        canvas.figure.set_dpi(100)
        canvas.figure.get_layout_engine().execute(canvas.figure)
        found.append(canvas.figure)
        file.touch()

    monkeypatch.setattr(FigureCanvasAgg, "print_png", draw)
    monkeypatch.setattr(FigureCanvasSVG, "print_svg", lambda _, file, **__: file.touch())
    return found


def point(*numbers):
    return "(" + " ".join(f"{round(number, 9) + 0.0:.4g}" for number in numbers) + ")"


def words_of(texts):
    return ", ".join(" ".join(text.get_text().split()) for text in texts)


def axis_words(axis, scale):
    """What an axis has that is not plain: its scale, how it writes a number, fixed ticks."""
    form = axis.get_major_formatter()
    known = {PercentFormatter: 0.5, EngFormatter: 20_000}.get(type(form))
    words = [scale] if scale != "linear" else []
    words += [] if known is None else [form(known)]
    if isinstance(axis.get_major_locator(), FixedLocator) and scale != "symlog":
        words.append(words_of(axis.get_ticklabels()))
    return f"{axis.axis_name} axis: {', '.join(words)}" if words else ""


def line_words(line):
    name = "" if line.get_label().startswith("_") else f"{line.get_label()}: "
    style = f"{NAMED[to_hex(line.get_color()).upper()]} {line.get_linestyle()}{line.get_marker()}"
    points = map(point, line.get_xdata(), line.get_ydata())
    return " ".join([f"{name}{style.replace('None', '')}", *points])


def area_words(found):
    if isinstance(found, PolyCollection):
        ends, colour = found.get_paths()[0].vertices, found.get_facecolor()[0]
        at = {x: ends[ends[:, 0] == x, 1] for x in np.unique(ends[:, 0])}
        points = " ".join(point(x, y.min(), y.max()) for x, y in at.items())
        return f"band {NAMED[to_hex(colour).upper()]} {colour[3]:.2g} {points}"
    if isinstance(found, LineCollection):
        return "across " + " ".join(point(*part.ravel()) for part in found.get_segments())
    assert isinstance(found, PathCollection)
    return "rings " + " ".join(point(*at) for at in found.get_offsets())


def patch_words(patch):
    colour = patch.get_facecolor() if patch.fill else patch.get_edgecolor()
    return f"{'bars' if patch.fill else 'frame'} {NAMED[to_hex(colour).upper()]}"


def described(figure):
    """What a figure shows, a line for each thing."""
    shown = []
    for axes in (axes for axes in figure.axes if axes.get_visible()):
        titles = axes.get_title(loc="left"), axes.get_xlabel(), axes.get_ylabel()
        shown.append(" | ".join(title.replace("\n", " ") or "-" for title in titles))
        x, y = axis_words(axes.xaxis, axes.get_xscale()), axis_words(axes.yaxis, axes.get_yscale())
        shown += [words for words in (x, y) if words]
        shown += [*map(line_words, axes.get_lines())]
        areas = [found for found in axes.collections if not isinstance(found, QuadMesh)]
        shown += map(area_words, areas)
        for kind, found in groupby(axes.patches, patch_words):
            shown.append(" ".join([kind, *(point(*patch.get_center()) for patch in found)]))
        if axes.texts:
            shown.append(f"text {words_of(axes.texts)}")
    shown += [f"names {words_of(legend.get_texts())}" for legend in figure.legends]
    return shown


EXPECTED = Path(__file__).with_name("figures.txt").read_text(encoding="utf-8")


def test_every_figure_of_a_study(drawn, tmp_path):
    paths = write_figures(whole_study(tmp_path, ["first", "second"], "lake"))
    assert {path.parent for path in paths} == {tmp_path / "figures"}
    assert [path.suffix for path in paths] == [".png", ".svg"] * len(drawn)
    shown = []
    for path, figure in zip(paths[::2], drawn, strict=True):
        shown += [f"# {path.stem}", *described(figure)]
    assert "\n".join(shown) + "\n" == EXPECTED


LONG = "a rule of our own, number {n}, that says all of its settings in its name, of $5"


def test_nothing_is_cut_by_matplotlibs_own_extents(drawn, tmp_path):
    names = [("W{n:02}" * 20 if n % 2 else LONG).format(n=n) for n in range(4)]
    paths = write_figures(whole_study(tmp_path, names, names[0], 79.0, names[1:2]))
    assert len(drawn) == 9
    for path, figure in zip(paths[::2], drawn, strict=True):
        FigureCanvasAgg(figure)  # which knows extents
        paper, inch = figure.bbox.padded(1), figure.dpi
        shown = [axes for axes in figure.axes if axes.get_visible()]
        legends = [legend.get_tightbbox() for legend in figure.legends]
        boxes = [axes.get_tightbbox() for axes in shown]
        for box in (*boxes, *legends):
            assert paper.contains(box.x0, box.y0), path.name
            assert paper.contains(box.x1, box.y1), path.name
        assert not any(legend.overlaps(box) for legend in legends for box in boxes), path.name
        for axes in shown:
            assert axes.bbox.width > 1.2 * inch, path.name
            assert axes.bbox.height > 0.8 * inch, path.name
