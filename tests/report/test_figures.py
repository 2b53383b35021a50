"""What figures show, asked of Matplotlib's axes: numbers, colours, words; and nothing is cut."""

from itertools import groupby

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection, PathCollection, PolyCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.ticker import EngFormatter, FixedLocator, PercentFormatter

from rl_yardstick.experiments.analysis import OverallAnalysis
from rl_yardstick.report.figures import write_figures
from rl_yardstick.report.series import (
    COLOURS,
    AgentRuns,
    ArmSeries,
    Belief,
    Curve,
    EnvironmentSeries,
    Grid,
    LearningCurves,
    PullSeries,
    RegretBounds,
    StudySeries,
    Sweep,
    agent_marks,
)
from tests.report import made_up

GREY = "#595959"
NAMED = {**dict(zip(COLOURS, ("blue", "orange", "green"), strict=False)), GREY: "grey"}
THIRD = np.array([0.0, 0.5, 1.0])
PULLS = np.array([1, 10, 100])
BOUNDS = RegretBounds(PULLS, np.array([10.0, 30.0, 90.0]), np.array([0.0, 5.0, 10.0]))


def curve(x, y):
    x, y = np.array(x, dtype=float), np.array(y, dtype=float)
    return Curve(x, y, y - 1, y + 2)


def curves_of(names, linear_up_to=None, on_variant=()):
    """Of each agent 40 less than of the one before; of the second one point of training."""
    steps = {name: curve([10, 20, 30], [5, 50 - 40 * n, 90]) for n, name in enumerate(names)}
    episodes = {name: curve([1, 2][n == 1 :], [7, 8][n == 1 :]) for n, name in enumerate(names)}
    nothing = {names[0]: curve([1, 2], [-1, -2])}  # on an axis that is not drawn
    return {
        "evaluation": LearningCurves({"step": steps, "episode": nothing}, linear_up_to),
        "training": LearningCurves({"step": nothing, "episode": episodes}, None, on_variant),
    }


def runs_of(names):
    some = {0: [85.0, 90, 95], 1: [40.0]}
    return [
        AgentRuns(name, made_up.estimate(90.0 - 50 * n), np.arange(3), np.array(some.get(n, [1.0])))
        for n, name in enumerate(names)
    ]


def whole_study(root, names, label, linear_up_to=None, on_variant=()):
    """A study that has every kind of figure; its agents rank in the order of their names."""
    agents = tuple(made_up.agent(name, 90.0 - 50 * n) for n, name in enumerate(names))
    lake, coins = made_up.environment(agents, label), made_up.environment(agents, "coins")
    labels = (names * 3)[:3]
    swept = {
        labels[0]: Sweep("α", curve([0.01, 0.1, 0.9], [30, 90, 3]), (labels[1], labels[0], "-")),
        labels[1]: Sweep("γ", curve([0.9, 0.95, 1], [1, 2, 3]), ("-", "-", "-")),
    }
    means = np.array([[90.0, 30.0], [40.0, np.nan]])
    grid = Grid(("γ", "kind"), ["1", "2"], labels[:2], means, [[labels[0], "-"], [labels[1], ""]])
    arms = ArmSeries(
        [f"context {context}, arm {arm}" for context in (0, 1) for arm in (0, 1)],
        np.array([0.1, 0.2, 0.3, 0.4]),
        {name: np.array([0.25, 0.75, 0.5, 0.5]) for name in names},
        {names[1]: (np.array([0.1, 0.3, 0.2, 0.5]), np.array([0.01, 0.02, 0.03, 0.04]))},
    )
    # The densities count up: by context, arm and point.
    densities = np.arange(12.0).reshape(1, 2, 2, 3)
    belief = Belief(names[1], np.array([2000]), THIRD, densities, [[0.25, 0.75], [None, 0.5]])
    pulls = {name: made_up.pulls(10.0 + 40 * n) for n, name in enumerate(names)}
    profiles = dict.fromkeys(names, 1 - THIRD)
    overall = OverallAnalysis({}, (), None, THIRD, profiles)
    learnt = curves_of(names, linear_up_to, on_variant)
    places = (
        EnvironmentSeries(lake, learnt, runs_of(names), None, swept, {"swept": grid}),
        EnvironmentSeries(coins, None, (), PullSeries(pulls, 75.0, BOUNDS, arms, (belief,)), {}),
    )
    found = made_up.analysis([lake, coins], names[::-1], root, overall=overall)
    columns = ["environment", "agent", "episode", "average", "minimum", "maximum"]
    rows = [(label, name, 5 * k, -20.0, -1000.0, 2.0 * k) for name in names for k in (1, 2)]
    blocks = pd.DataFrame(rows, columns=columns)
    return StudySeries(found, agent_marks(found.study), places), blocks


@pytest.fixture
def drawn(monkeypatch):
    """Figures with all in its place, as they were written; of fewer points, which is faster."""
    found = []

    def draw(canvas, file, **_):
        canvas.figure.set_dpi(100)
        canvas.draw()
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
        shown += [
            area_words(found) for found in axes.collections if not isinstance(found, QuadMesh)
        ]
        for kind, found in groupby(axes.patches, patch_words):
            shown.append(" ".join([kind, *(point(*patch.get_center()) for patch in found)]))
        if axes.texts:
            shown.append(f"text {words_of(axes.texts)}")
    shown += [f"names {words_of(legend.get_texts())}" for legend in figure.legends]
    return shown


EXPECTED = """
# coins_pulls
coins, 4 runs | pulls | average reward
first: orange -- (1 10) (10 11) (100 12)
second: blue - (1 50) (10 51) (100 52)
best possible: grey - (1 75) (100 75)
text first, second, best possible
- | pulls | runs that pull a best arm
y axis: 50%
first: orange -- (1 0.1) (10 0.11) (100 0.12)
second: blue - (1 0.5) (10 0.51) (100 0.52)
text first, second
# coins_regret
coins: mean of 4 runs, its 95 % interval, and 90% of the runs | pulls (log scale) | cumulative regret
x axis: log
first: orange -- (1 30) (10 31) (100 32)
second: blue - (1 70) (10 71) (100 72)
Auer's bound for UCB1: grey -- (1 10) (10 30) (100 90)
Lai-Robbins slope: grey : (1 0) (10 5) (100 10)
band orange 0.3 (1 30 30) (10 29.04 32.96) (100 28.08 35.92)
band orange 0.08 (1 21 42) (10 22 43) (100 23 44)
band blue 0.3 (1 70 70) (10 69.04 72.96) (100 68.08 75.92)
band blue 0.08 (1 61 82) (10 62 83) (100 63 84)
text first, second, Auer's bound for UCB1 ↑, Lai-Robbins slope
of recommending the arm pulled most | pulls (log scale) | simple regret
x axis: log
first: orange -- (1 40) (10 41) (100 42)
second: blue - (1 80) (10 81) (100 82)
text first, second
# coins_arms
pulls, by context | - | share of the pulls
x axis: context 0 arm 0, context 0 arm 1, context 1 arm 0, context 1 arm 1
y axis: 50%
bars orange (-0.2 0.125) (0.8 0.375) (1.8 0.25) (2.8 0.25)
bars blue (0.2 0.125) (1.2 0.375) (2.2 0.25) (3.2 0.25)
final estimates, mean and spread over runs; lines across are the truth | - | mean reward
x axis: context 0 arm 0, context 0 arm 1, context 1 arm 0, context 1 arm 1
blue o (0.2 0.1) (1.2 0.3) (2.2 0.2) (3.2 0.5)
across (0.2 0.09 0.2 0.11) (1.2 0.28 1.2 0.32) (2.2 0.17 2.2 0.23) (3.2 0.46 3.2 0.54)
across (-0.42 0.1 0.42 0.1) (0.58 0.2 1.42 0.2) (1.58 0.3 2.42 0.3) (2.58 0.4 3.42 0.4)
names first, second
# coins_second_posteriors
second, context 0, after 2,000 pulls | mean reward | density
arm 0: blue - (0 0) (0.5 1) (1 2)
blue : (0.25 0) (0.25 1)
arm 1: orange - (0 3) (0.5 4) (1 5)
orange : (0.75 0) (0.75 1)
second, context 1, after 2,000 pulls | mean reward | density
arm 0: blue - (0 6) (0.5 7) (1 8)
arm 1: orange - (0 9) (0.5 10) (1 11)
orange : (0.5 0) (0.5 1)
# lake_sweep
lake | value of the parameter (log scale) | return of the final policy
x axis: log, 0.01, 0.1, 0.9
first, α: blue -o (0.01 30) (0.1 90) (0.9 3)
second, γ: orange --o (0.9 1) (0.95 2) (1 3)
across (0.01 29 0.01 32) (0.1 89 0.1 92) (0.9 2 0.9 5)
across (0.9 0 0.9 3) (0.95 1 0.95 4) (1 2 1 5)
rings (0.1 90)
names first, α, second, γ, best mean: first, 95 % interval
# lake_swept_grid
lake: return of the final policy, means over seeds; the best mean in a frame | kind | γ
x axis: first, second
y axis: 1, 2
frame orange (0 0)
text 90, 30, 40
# lake_learning_curves
lake: evaluations | environment steps | return
x axis: 20k
first: orange -- (10 5) (20 50) (30 90)
second: blue - (10 5) (20 10) (30 90)
optimum: grey - (0 100) (1 100)
best random or constant policy: grey : (0 20) (1 20)
band orange 0.2 (10 4 7) (20 49 52) (30 89 92)
band blue 0.2 (10 4 7) (20 9 12) (30 89 92)
training episodes | episodes | return
x axis: 20k
first: orange -- (1 7) (2 8)
second: blue -o (2 8)
optimum: grey - (0 100) (1 100)
best random or constant policy: grey : (0 20) (1 20)
band orange 0.2 (1 6 9) (2 7 10)
band blue 0.2 (2 7 10)
names first, second, optimum, best random or constant policy, 95 % interval
# lake_intervals
lake; the line is the optimum; best: none | return of the final policy; mean, 95 % interval, each seed | -
y axis: second, first
blue . (40 0)
blue - (39.9 0) (40.2 0)
blue | (40 0)
orange . (85 0.82) (90 1) (95 1.18)
orange - (89.9 1) (90.2 1)
orange | (90 1)
grey - (100 0) (100 1)
# lake_episodes
first | episode | return
orange -o (5 -20) (10 -20)
orange :o (5 -1000) (10 -1000)
orange --o (5 2) (10 4)
average: grey -o
minimum: grey :o
maximum: grey --o
second | episode | return
blue -o (5 -20) (10 -20)
blue :o (5 -1000) (10 -1000)
blue --o (5 2) (10 4)
names average, minimum, maximum
# performance_profiles
Performance profiles over environments | score | share of runs with a higher score
y axis: 50%
first: orange -- (0 1) (0.5 0.5) (1 0)
second: blue - (0 1) (0.5 0.5) (1 0)
names first, second
"""  # noqa: E501  # as it is drawn


def test_every_figure_of_a_study(drawn, tmp_path):
    paths = write_figures(*whole_study(tmp_path, ["first", "second"], "lake"))
    assert {path.parent for path in paths} == {tmp_path / "figures"}
    assert [path.suffix for path in paths] == [".png", ".svg"] * len(drawn)
    shown = [""]
    for path, figure in zip(paths[::2], drawn, strict=True):
        shown += [f"# {path.stem}", *described(figure)]
    assert "\n".join(shown) + "\n" == EXPECTED


LONG = "a rule of our own, number {n}, that says all of its settings in its name, of $5"


def test_nothing_is_cut_by_matplotlibs_own_extents(drawn, tmp_path):
    names = [("W{n:02}" * 20 if n % 2 else LONG).format(n=n) for n in range(4)]
    paths = write_figures(*whole_study(tmp_path, names, names[0], 79.0, names[1:2]))
    assert len(drawn) == 10
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
