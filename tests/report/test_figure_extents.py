"""Nothing that a figure says is cut, by Matplotlib's own extents, whatever names are like."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from experiments.analysis import OverallAnalysis
from experiments.bandits import PullStatistics
from report import figures
from report.figures import write_figures
from report.series import (
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
from verdicts import Band

NAMES = {
    "short": "agent {n}, of $5",
    "long": "a rule of our own, number {n}, that says all of its settings in its name, alas",
    "unbroken": "W{n:02}" * 20,
}
PULLS = np.arange(1, 1001)


def curve(height):
    x = np.linspace(0, 1e6, 5)
    y = np.array([-1000, -300, 50, height, height], dtype=float)
    return Curve(x, y, y - 10, y + 10)


def statistics(end):
    rise = end * PULLS / PULLS[-1]
    nothing = np.empty(0)
    return PullStatistics(
        pulls=PULLS,
        reward=rise,
        optimal=rise / 1000,
        regret=rise,
        cumulative_regret=rise,
        cumulative_regret_sem=rise / 10,
        cumulative_regret_quantiles=np.array([rise * k for k in (0.5, 0.8, 1, 1.2, 2)]),
        simple_regret=rise[::-1],
        total_reward=np.zeros(30),
        total_regret=np.zeros(30),
        shares=nothing,
        context_regret=nothing,
        estimates=nothing,
        estimates_std=nothing,
        true_means=nothing,
        moments=np.empty(0, dtype=np.int64),
        posteriors=nothing,
    )


def all_figures(made_up, root, names):
    """A study that has every kind of figure, whose environment is named like its agents."""
    place = names[0]
    agents = [made_up.agent(name, 70.0 - n, on_variant=n == 1) for n, name in enumerate(names)]
    environment = made_up.environment(agents, place)
    curves = {name: curve(70 - n) for n, name in enumerate(names)}
    by_axis = {"step": curves, "episode": curves, "seconds": {}}
    kinds = {"evaluation": (), "training": tuple(names[:1])}
    learning = {kind: LearningCurves(by_axis, 79.0, who) for kind, who in kinds.items()}
    seeds = np.arange(5)
    runs = [AgentRuns(a.agent, a.metric.mean, seeds, seeds) for a in agents]
    x = np.array([0.001, 0.1, 0.9])
    means = Curve(x, x * 50, x * 40, x * 60)
    sweeps = {name: Sweep(name, means, tuple((names * 2)[:3])) for name in names}
    shape = (len(names), len(names))
    grid = Grid(
        ("learning_rate_of_the_critic", "n_steps"),
        names,
        names,
        np.arange(float(np.prod(shape))).reshape(shape),
        [names] * len(names),
    )
    few = np.full(4, 0.25)
    arms = ArmSeries(
        [f"context {c}, arm {a}" for c in (0, 1) for a in (0, 1)], few,
        dict.fromkeys(names, few), dict.fromkeys(names, (few, few)),
    )  # fmt: skip
    belief = Belief(
        place,
        np.array([10, 100, 1000, 10000]),
        np.linspace(0, 1, 9),
        np.ones((4, 2, 3, 9)),
        [[0.1] * 3] * 2,
    )
    bounds = RegretBounds(PULLS, PULLS * 1.0, PULLS * 0.1)
    pulls = PullSeries(
        {n: statistics(100.0 + k) for k, n in enumerate(names)}, 99.0, bounds, arms, (belief,)
    )
    third = np.array([1.0, 0.5, 0.0])
    overall = OverallAnalysis(
        {}, {}, third[::-1], {name: Band(third, third, third) for name in names}
    )
    analysis = made_up.analysis([environment], names, root, overall=overall)
    one = EnvironmentSeries(environment, learning, runs, pulls, sweeps, {place: grid})
    rows = [(place, name, k, -20.0, -1000.0, 2.0 * k) for name in names for k in (5, 10)]
    blocks = pd.DataFrame(
        rows, columns=["environment", "agent", "episode", "average", "minimum", "maximum"]
    )
    return StudySeries(analysis, agent_marks(analysis.study), (one,)), blocks


@pytest.fixture
def laid_out(monkeypatch):
    """Figures with all in its place, as they would be written."""
    found = []

    def lay_out(canvas, form, file):
        if form == "png":
            canvas.set_dpi(100)  # which is faster
            FigureCanvasAgg(canvas).draw()
            found.append(canvas)

    monkeypatch.setattr(figures, "write", lay_out)
    return found


@pytest.mark.parametrize(
    ("n_agents", "kind"),
    [(2, "long"), (5, "short"), (7, "unbroken"), (12, "long")],
)
def test_nothing_is_cut(made_up, laid_out, tmp_path, n_agents, kind):
    names = [NAMES[kind].format(n=n) for n in range(n_agents)]
    series, blocks = all_figures(made_up, tmp_path, names)
    paths = write_figures(series, blocks)
    assert len(laid_out) == len(paths) / 2 == 10
    for path, figure in zip(paths[::2], laid_out, strict=True):
        paper, inch = figure.bbox.padded(1), figure.dpi
        places = [axes for axes in figure.axes if axes.get_visible()]
        for part in (*places, *figure.legends):
            box = part.get_tightbbox()
            assert paper.contains(box.x0, box.y0), path.name
            assert paper.contains(box.x1, box.y1), path.name
            if part in places:
                assert not any(legend.get_tightbbox().overlaps(box) for legend in figure.legends)
        for axes in places:
            assert axes.bbox.width > 1.2 * inch, path.name
            assert axes.bbox.height > 0.8 * inch, path.name
            columns = [axes.texts, axes.get_yticklabels() if "intervals" in path.name else []]
            for texts in columns if "grid" not in path.name else []:
                boxes = sorted((Text.get_window_extent(t) for t in texts), key=lambda box: box.y0)
                assert all(low.y1 <= high.y0 + 1 for low, high in pairwise(boxes)), path.name
