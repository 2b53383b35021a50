"""What the figures of a bandit show, asked of Matplotlib's axes."""

import numpy as np
import pytest

from experiments.bandits import PullStatistics
from report.figures import (
    draw_arms,
    draw_belief,
    draw_regret,
    draw_rewards,
    draw_simple_regret,
    write_figures,
)
from report.series import (
    COLOURS,
    ArmSeries,
    Belief,
    EnvironmentSeries,
    Mark,
    PullSeries,
    RegretBounds,
    StudySeries,
)

BLUE, ORANGE, GREEN = COLOURS[:3]
GREY = "#595959"
MARKS = {"first": Mark("first", 1, "solid"), "second": Mark("second", 0, "dash")}
PULLS = np.array([1, 10, 100])


def statistics(start, n_runs=4):
    """Figures that begin with ``start``, each ten higher than the one before."""
    rise = np.array([0.0, 1.0, 2.0])
    nothing = np.empty(0)
    return PullStatistics(
        pulls=PULLS,
        reward=start + rise,
        optimal=(start + rise) / 100,
        regret=start + 10 + rise,
        cumulative_regret=start + 20 + rise,
        cumulative_regret_sem=np.array([0.0, 1.0, 2.0]),
        cumulative_regret_quantiles=np.array([start + 20 + rise + d for d in (-9, -3, -1, 3, 12)]),
        simple_regret=start + 30 + rise,
        total_reward=np.zeros(n_runs),
        total_regret=np.zeros(n_runs),
        shares=nothing,
        context_regret=nothing,
        estimates=nothing,
        estimates_std=nothing,
        true_means=nothing,
        moments=np.empty(0, dtype=np.int64),
        posteriors=nothing,
    )


BOUNDS = RegretBounds(PULLS, np.array([10.0, 30.0, 90.0]), np.array([0.0, 5.0, 10.0]))
ARMS = ArmSeries(
    [f"context {context}, arm {arm}" for context in (0, 1) for arm in (0, 1)],
    np.array([0.1, 0.2, 0.3, 0.4]),
    {"first": np.array([0.25, 0.75, 0.5, 0.5]), "second": np.array([1, 0, 0, 1.0])},
    {"second": (np.array([0.1, 0.3, 0.2, 0.5]), np.array([0.01, 0.02, 0.03, 0.04]))},
)
BELIEF = Belief(
    "second",
    np.array([10, 2000]),
    np.array([0.0, 0.5, 1.0]),
    np.arange(24.0).reshape(2, 2, 2, 3),
    [[0.25, 0.75], [None, 0.5]],
)


def series(**changes):
    known = {
        "pulls": {"first": statistics(10), "second": statistics(50)},
        "best": 75.0,
        "bounds": None,
        "arms": None,
        "beliefs": (),
    }
    return PullSeries(**known | changes)


def test_rewards_above_and_best_arms_below(axes, drawn):
    places = axes(2)
    draw_rewards(*places, series(), "coins", MARKS)
    left, right = map(drawn, places)
    assert left.names == left.ends == ["first", "second", "best possible"]
    assert right.names == right.ends == ["first", "second"]
    assert [line["y"] for line in left.lines] == [[10, 11, 12], [50, 51, 52], [75, 75]]
    assert [line["y"] for line in right.lines] == [[0.1, 0.11, 0.12], [0.5, 0.51, 0.52]]
    for place in (left, right):
        assert [line["x"] for line in place.lines[:2]] == [[1, 10, 100]] * 2
        assert [line["colour"] for line in place.lines[:2]] == [ORANGE, BLUE]
        assert [line["style"] for line in place.lines[:2]] == ["-", "--"]
    assert left.line("best possible")["colour"] == GREY
    assert left.title == "coins, 4 runs"
    assert left.labels == ("pulls", "average reward")
    assert right.labels == ("pulls", "runs that pull a best arm")
    assert right.axes.get_ylim() == (0, 1)
    assert right.axes.yaxis.get_major_formatter()(0.5) == "50%"


def test_no_line_for_a_best_reward_that_is_not_known(axes, drawn):
    places = axes(2)
    draw_rewards(*places, series(best=None), "coins", MARKS)
    assert drawn(places[0]).names == ["first", "second"]


def test_regret_with_its_interval_and_the_spread_of_runs(axes, drawn):
    (axis,) = axes()
    draw_regret(axis, series(), "coins", MARKS)
    place = drawn(axis)
    assert place.names == place.ends == ["first", "second"]
    assert [line["y"] for line in place.lines] == [[30, 31, 32], [70, 71, 72]]
    assert [line["x"] for line in place.lines] == [[1, 10, 100]] * 2
    assert [band["colour"] for band in place.bands] == [ORANGE, ORANGE, BLUE, BLUE]
    assert [band["alpha"] for band in place.bands] == [0.3, 0.08] * 2
    interval, spread = (band["ends"] for band in place.bands[:2])
    assert interval[1] == (30, 30)
    assert interval[100] == pytest.approx((32 - 2 * 1.96, 32 + 2 * 1.96))
    assert spread == {1: (21, 42), 10: (22, 43), 100: (23, 44)}
    assert place.title == "coins: mean of 4 runs, its 95 % interval, and 90% of the runs"
    assert place.labels == ("pulls (log scale)", "cumulative regret")
    assert place.axes.get_xscale() == "log"


@pytest.mark.parametrize(
    ("n_agents", "n_bands", "words", "highest"),
    [
        (2, 4, ", its 95 % interval, and 90% of the runs", 10 + 20 + 2 + 12),
        (4, 4, " with its 95 % interval", 30 + 20 + 2 + 2 * 1.96),
        (5, 0, "", 40 + 20 + 2),
    ],
)
def test_there_are_four_bands_at_most(axes, drawn, n_agents, n_bands, words, highest):
    pulls = {f"agent {n}": statistics(10 * n) for n in range(n_agents)}
    (axis,) = axes()
    draw_regret(
        axis, series(pulls=pulls), "coins", {name: Mark(name, 0, "solid") for name in pulls}
    )
    assert len(drawn(axis).bands) == n_bands
    assert drawn(axis).title == f"coins: mean of 4 runs{words}"
    assert axis.get_ylim() == pytest.approx((0, 1.05 * highest))  # which ends with what is drawn


def test_bounds_and_the_height_that_they_leave(axes, drawn):
    (axis,) = axes()
    draw_regret(axis, series(bounds=BOUNDS), "coins", MARKS)
    place = drawn(axis)
    assert place.names == ["first", "second", "Auer's bound for UCB1", "Lai-Robbins slope"]
    auer, slope = place.line("Auer's bound for UCB1"), place.line("Lai-Robbins slope")
    assert (auer["x"], auer["y"]) == ([1, 10, 100], [10, 30, 90])
    assert (slope["x"], slope["y"]) == ([1, 10, 100], [0, 5, 10])
    assert (auer["style"], slope["style"]) == ("--", ":")
    assert {auer["colour"], slope["colour"]} == {GREY}
    low, high = place.axes.get_ylim()
    assert (low, high) == pytest.approx((0, 1.05 * 84))  # of the highest run; the bound is cut
    assert place.ends == ["first", "second", "Auer's bound for UCB1 ↑", "Lai-Robbins slope"]


@pytest.mark.parametrize(
    ("last", "n_shown", "highest"),
    [(1000.0, 2, None), (50.0, 3, 52.5)],  # a bound far above is cut; one far below sets the limit
)
def test_a_bound_that_does_not_fit(axes, drawn, last, n_shown, highest):
    (axis,) = axes()
    bounds = RegretBounds(PULLS, np.array([10.0, 30.0, last]), BOUNDS.lai_robbins)
    draw_regret(axis, series(bounds=bounds), "coins", MARKS)
    place = drawn(axis)
    assert len(place.line("Auer's bound for UCB1")["x"]) == n_shown
    if highest is not None:
        assert place.axes.get_ylim() == pytest.approx((0, highest))


def test_simple_regret(axes, drawn):
    (axis,) = axes()
    draw_simple_regret(axis, series(), MARKS)
    place = drawn(axis)
    assert [line["y"] for line in place.lines] == [[40, 41, 42], [80, 81, 82]]
    assert [line["x"] for line in place.lines] == [[1, 10, 100]] * 2
    assert [line["colour"] for line in place.lines] == [ORANGE, BLUE]
    assert place.labels == ("pulls (log scale)", "simple regret")
    assert place.title == "of recommending the arm pulled most"
    assert place.axes.get_xscale() == "log"


def test_arms_side_by_side_within_each_context(axes, drawn):
    left, right = axes(2)
    draw_arms(left, right, ARMS, MARKS)
    first, second = left.containers
    assert (first.get_label(), second.get_label()) == ("first", "second")
    assert [bar.get_height() for bar in first] == [0.25, 0.75, 0.5, 0.5]
    assert [bar.get_height() for bar in second] == [1, 0, 0, 1]
    assert [bar.get_x() for bar in first] == pytest.approx([-0.4, 0.6, 1.6, 2.6])
    assert [bar.get_x() for bar in second] == pytest.approx([0, 1, 2, 3])
    assert drawn(left).shared_legend == ["first", "second"]
    names = ["context 0\narm 0", "context 0\narm 1", "context 1\narm 0", "context 1\narm 1"]
    for place in (left, right):
        assert [text.get_text() for text in place.get_xticklabels()] == names
    assert drawn(left).labels[1] == "share of the pulls"
    assert drawn(left).title == "pulls, by context"
    assert left.get_ylim() == (0, 1)
    assert left.yaxis.get_major_formatter()(0.5) == "50%"


def test_estimates_beside_the_truth(axes, drawn):
    left, right = axes(2)
    draw_arms(left, right, ARMS, MARKS)
    (estimates,) = right.containers  # of the second agent alone, at its bars
    dots, _, (bars,) = estimates
    assert dots.get_xdata() == pytest.approx([0.2, 1.2, 2.2, 3.2])
    assert dots.get_ydata().tolist() == [0.1, 0.3, 0.2, 0.5]
    assert dots.get_color() == BLUE
    lengths = [segment[1, 1] - segment[0, 1] for segment in bars.get_segments()]
    assert lengths == pytest.approx([0.02, 0.04, 0.06, 0.08])
    truth = right.collections[-1].get_segments()
    assert [segment[0, 1] for segment in truth] == [0.1, 0.2, 0.3, 0.4]
    assert np.mean(truth, axis=1)[:, 0] == pytest.approx([0, 1, 2, 3])
    assert drawn(right).labels[1] == "mean reward"
    assert drawn(right).title == (
        "final estimates, mean and spread over runs; lines across are the truth"
    )


def test_beliefs_by_context_and_moment(axes, drawn):
    panels = axes(4)
    draw_belief(panels, BELIEF)
    places = [drawn(panel) for panel in panels]
    assert [place.title for place in places] == [
        "second, context 0, after 10 pulls",
        "second, context 0, after 2,000 pulls",
        "second, context 1, after 10 pulls",
        "second, context 1, after 2,000 pulls",
    ]
    densities = [[line["y"] for line in place.lines if line["label"]] for place in places]
    # The densities count up: by moment, context, arm and point.
    assert densities == [
        [[0, 1, 2], [3, 4, 5]],
        [[12, 13, 14], [15, 16, 17]],
        [[6, 7, 8], [9, 10, 11]],
        [[18, 19, 20], [21, 22, 23]],
    ]
    for place in places:
        assert place.names == ["arm 0", "arm 1"]
        assert [place.line(name)["colour"] for name in place.names] == [BLUE, ORANGE]
        assert place.line("arm 0")["x"] == [0, 0.5, 1]
        assert place.labels == ("mean reward", "density")
    truths = [[line["x"] for line in place.lines if not line["label"]] for place in places]
    assert truths == [[[0.25] * 2, [0.75] * 2]] * 2 + [[[0.5] * 2]] * 2
    assert [place.legend for place in places] == [["arm 0", "arm 1"], None, None, None]


def test_a_single_context_is_not_named(axes, drawn):
    panels = axes(2)
    draw_belief(
        panels,
        Belief("blind", BELIEF.moments, BELIEF.points, BELIEF.densities[:, :1], [[None, None]]),
    )
    assert [drawn(panel).title for panel in panels] == [
        "blind, after 10 pulls",
        "blind, after 2,000 pulls",
    ]
    assert len(drawn(panels[0]).lines) == 2


@pytest.fixture
def study(made_up, tmp_path):
    """A study of one bandit, to be drawn from what is handed in."""

    def make(pulls, agents=("first", "second")):
        place = made_up.environment([made_up.agent(name, 1.0) for name in agents], "coins")
        analysis = made_up.analysis([place], agents, tmp_path, metric="regret")
        one = EnvironmentSeries(place, None, (), pulls, {})
        marks = {name: MARKS.get(name, Mark(name, 2, "solid")) for name in agents}
        return StudySeries(analysis, marks, (one,))

    return make


def test_files_of_a_bandit(study, canvases, drawn):
    paths = write_figures(study(series(arms=ARMS, beliefs=(BELIEF,))), None)
    stems = [f"coins_{kind}" for kind in ("pulls", "regret", "arms", "second_posteriors")]
    assert [path.stem for path in paths[::2]] == stems
    assert [len(canvases[stem]) for stem in stems] == [2, 2, 2, 4]
    assert [drawn(place).labels[1] for place in canvases["coins_regret"]] == [
        "cumulative regret",
        "simple regret",
    ]
    assert drawn(canvases["coins_pulls"][0]).labels[1] == "average reward"


def test_agents_without_a_simple_regret_leave_no_empty_panel(study, canvases):
    pulls = {"first": statistics(10)}
    pulls["first"].simple_regret[:] = np.nan
    write_figures(study(series(pulls=pulls)), None)
    assert len(canvases["coins_regret"]) == 1


def test_too_many_agents_on_a_bandit_make_no_lines(study):
    names = [f"agent {n}" for n in range(15)]
    crowd = {name: statistics(10) for name in names}
    arms = ArmSeries(["arm 0"], np.ones(1), dict.fromkeys(names, np.ones(1)), {})
    assert write_figures(study(series(pulls=crowd, arms=arms), tuple(names)), None) == []
