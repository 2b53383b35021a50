"""What the figures of a study show, asked of Matplotlib's axes."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from experiments.analysis import OverallAnalysis
from report.figures import (
    draw_blocks,
    draw_grid,
    draw_learning_curves,
    draw_profiles,
    draw_runs,
    draw_sweeps,
    line_style,
    write_figures,
)
from report.series import (
    COLOURS,
    DASHES,
    AgentRuns,
    Curve,
    EnvironmentSeries,
    Grid,
    LearningCurves,
    Mark,
    StudySeries,
    Sweep,
    agent_marks,
)
from verdicts import Band

BLUE, ORANGE, GREEN = COLOURS[:3]
GREY = "#595959"  # Matplotlib's 0.35
MARKS = {
    "first": Mark("first", 1, "solid"),
    "second": Mark("second", 0, "dash"),
}


def curve(x, y, below=1.0, above=2.0):
    x, y = np.array(x, dtype=float), np.array(y, dtype=float)
    return Curve(x, y, y - below, y + above)


def learning_curves(linear_up_to=None, on_variant=()):
    return {
        "evaluation": LearningCurves(
            {
                "step": {
                    "first": curve([10, 20, 30], [5, 50, 90]),
                    "second": curve([10, 20], [4, 40]),
                },
                "episode": {"first": curve([1, 2], [-1, -2])},
                "seconds": {},
            },
            linear_up_to,
        ),
        "training": LearningCurves(
            {
                "step": {"first": curve([1, 2], [-3, -4])},
                "episode": {
                    "first": curve([1, 2, 3], [7, 8, 9]),
                    "second": curve([3], [6]),
                },
                "seconds": {},
            },
            None,
            on_variant,
        ),
    }


# --- learning curves -----------------------------------------------------------------------------


@pytest.fixture
def curves_drawn(axes, drawn, made_up):
    def draw(linear_up_to=None, on_variant=(), **changes):
        places = axes(2)
        environment = made_up.environment(**changes)
        curves = learning_curves(linear_up_to, on_variant)
        draw_learning_curves(places, curves, environment, MARKS)
        return [drawn(place) for place in places]

    return draw


def test_evaluations_by_step_on_the_left_and_training_by_episode_on_the_right(curves_drawn):
    left, right = curves_drawn()
    assert (
        left.names
        == right.names
        == ["first", "second", "optimum", "best random or constant policy"]
    )
    assert (left.line("first")["x"], left.line("first")["y"]) == ([10, 20, 30], [5, 50, 90])
    assert (left.line("second")["x"], left.line("second")["y"]) == ([10, 20], [4, 40])
    assert (right.line("first")["x"], right.line("first")["y"]) == ([1, 2, 3], [7, 8, 9])
    assert (right.line("second")["x"], right.line("second")["y"]) == ([3], [6])


@pytest.mark.parametrize(
    ("on_variant", "words"), [(("second",), "second"), (("first", "second"), "2 agents")]
)
def test_no_optimum_stands_beside_training_on_a_variant(curves_drawn, on_variant, words):
    left, right = curves_drawn(on_variant=on_variant)
    assert right.names == ["first", "second"]
    assert right.title == f"training episodes ({words}: on a variant of the environment)"
    circles = "trained on a variant of the environment"
    names = ["first", "second", "optimum", "best random or constant policy", circles]
    assert left.names == names
    assert left.shared_legend == [*names, "95 % interval"]
    # Circles lie on their curves and on no other.
    marked = [line for line in right.lines if line["label"] is None]
    assert [(line["x"], line["y"]) for line in marked] == [
        (right.line(name)["x"], right.line(name)["y"]) for name in on_variant
    ]
    assert {line["marker"] for line in marked} == {left.line(circles)["marker"]} == {"o"}
    assert left.title == "lake: evaluations"


def test_every_curve_has_its_colour_its_dashes_and_its_interval(curves_drawn):
    left, right = curves_drawn()
    assert (left.line("first")["colour"], left.line("first")["style"]) == (ORANGE, "-")
    assert (left.line("second")["colour"], left.line("second")["style"]) == (BLUE, "--")
    first, second = left.bands
    assert (first["colour"], second["colour"]) == (ORANGE, BLUE)
    assert first["ends"] == {10: (4, 7), 20: (49, 52), 30: (89, 92)}
    assert second["ends"] == {10: (3, 6), 20: (39, 42)}
    assert len(right.bands) == 2


def test_a_curve_of_one_point_is_a_dot(curves_drawn):
    left, right = curves_drawn()
    assert right.line("second")["marker"] == "o"
    assert {line["marker"] for line in left.lines if line["label"] in MARKS} == {""}


def test_the_optimum_and_the_baseline_policy_are_lines_across(curves_drawn):
    for place in curves_drawn():
        assert place.line("optimum")["y"] == [100, 100]
        assert place.line("best random or constant policy")["y"] == [20, 20]
        assert (
            place.line("optimum")["style"],
            place.line("best random or constant policy")["style"],
        ) == (
            "-",
            ":",
        )
        assert place.line("optimum")["colour"] == GREY


def test_both_ends_of_a_bracket_are_lines_across(curves_drawn):
    for place in curves_drawn(optimum_at_least=90.0):
        assert place.line("optimum, at most")["y"] == [100, 100]
        assert place.line("optimum, at least")["y"] == [90, 90]
        assert place.line("optimum, at least")["style"] == "--"


def test_where_the_optimum_is_not_known_no_line_stands_for_it(curves_drawn):
    left, right = curves_drawn(optimum=None, baseline=None)
    assert left.names == right.names == ["first", "second"]
    assert left.shared_legend == ["first", "second", "95 % interval"]


def test_words_around_the_curves(curves_drawn):
    left, right = curves_drawn()
    assert left.title == "lake: evaluations"
    assert right.title == "training episodes"
    assert left.labels == ("environment steps", "return")
    assert right.labels == ("episodes", "return")
    references = ["optimum", "best random or constant policy"]
    assert left.shared_legend == ["first", "second", *references, "95 % interval"]
    assert left.axes.xaxis.get_major_formatter()(20_000) == "20k"


def test_an_axis_is_logarithmic_where_some_returns_dwarf_the_others(curves_drawn):
    left, right = curves_drawn(linear_up_to=79.0)
    assert (left.axes.get_yscale(), right.axes.get_yscale()) == ("symlog", "linear")
    assert left.axes.yaxis.get_transform().linthresh == 79
    ticks = left.axes.get_yticks()
    assert [tick for tick in ticks if abs(tick) < 2000] == [
        *(-1000, -300, -100, -50, 0, 50, 100, 300, 1000)
    ]
    assert [place.labels[1] for place in (left, right)] == [
        "return (log scale beyond ±79)",
        "return",
    ]
    assert left.axes.yaxis.get_major_formatter()(-1000.0) == "\N{MINUS SIGN}1,000"
    # Nothing stands beyond the limits, and little room is left outside.
    low, high = left.axes.get_ylim()
    assert -10 < low < 3
    assert 100 < high < 120


# --- runs ----------------------------------------------------------------------------------------


def run_series(made_up):
    seeds = np.arange(3)
    return [
        AgentRuns("first", made_up.estimate(90.0, 80.0, 95.0), seeds, np.array([85, 90, 95.0])),
        AgentRuns("second", made_up.estimate(40.0, 35.0, 45.0), seeds[:1], np.array([40.0])),
    ]


@pytest.fixture
def runs_drawn(axes, drawn, made_up):
    def draw(metric="final", **changes):
        (place,) = axes()
        draw_runs(place, run_series(made_up), made_up.environment(**changes), metric, MARKS)
        return drawn(place)

    return draw


def test_the_best_agent_stands_on_top_with_its_dots_its_interval_and_its_mean(runs_drawn):
    place = runs_drawn()
    below, above = place.lines[:3], place.lines[3:6]
    assert [line["x"] for line in above] == [[85, 90, 95], [80, 95], [90]]
    assert above[0]["y"] == pytest.approx([0.82, 1, 1.18])
    assert [line["y"] for line in above[1:]] == [[1, 1], [1]]
    assert [line["x"] for line in below] == [[40], [35, 45], [40]]
    assert [line["y"] for line in below] == [[0], [0, 0], [0]]
    assert [line["marker"] for line in above] == [".", "None", "|"]
    assert {line["colour"] for line in above} == {ORANGE}
    assert {line["colour"] for line in below} == {BLUE}
    assert place.axes.get_yticks().tolist() == [0, 1]
    assert [text.get_text() for text in place.axes.get_yticklabels()] == ["second", "first"]
    assert place.axes.get_ylim() == (-0.6, 1.6)


@pytest.mark.parametrize(
    ("metric", "words", "has_line"),
    [
        ("final", "return of the final policy", True),
        ("best", "return of the best policy during training", True),
        ("area", "mean return over the learning curve", False),
        ("regret", "regret of a run", False),
    ],
)
def test_the_optimum_of_runs_is_drawn_where_they_can_reach_it(runs_drawn, metric, words, has_line):
    place = runs_drawn(metric)
    assert len(place.lines) == 6 + has_line
    assert place.title == "lake" + "; the line is the optimum" * has_line
    assert place.labels == (f"{words}; mean, 95 % interval, each seed", "")
    if has_line:
        assert (place.lines[-1]["x"], place.lines[-1]["colour"]) == ([100, 100], GREY)


def test_runs_are_drawn_beside_both_ends_of_a_bracket(runs_drawn):
    place = runs_drawn(optimum_at_least=90.0)
    assert [line["x"] for line in place.lines[6:]] == [[100, 100], [90, 90]]
    assert place.title == "lake; the optimum lies between the lines"


def test_runs_without_a_known_optimum(runs_drawn):
    place = runs_drawn(optimum=None)
    assert len(place.lines) == 6
    assert place.title == "lake"


# --- sweeps, blocks, profiles --------------------------------------------------------------------


def sweep(parameter, x, y):
    return Sweep(parameter, curve(x, y), tuple(f"{parameter} = {value}" for value in x))


def ranked(made_up, *sweeps):
    """An environment where the agents of these sweeps have their means."""
    means = {k: v for one in sweeps for k, v in zip(one.labels, one.means.y, strict=True)}
    labels = sorted(means, key=lambda label: -means[label])
    return made_up.environment([made_up.agent(label, means[label]) for label in labels])


def test_a_line_for_each_swept_parameter(axes, drawn, made_up):
    (axis,) = axes()
    sweeps = {
        "sarsa": sweep("a", [0.01, 0.1, 0.9], [10, 30, 20]),
        "dqn": sweep("g", [0.9, 0.95, 1], [1, 2, 3]),
    }
    draw_sweeps(axis, sweeps, ranked(made_up, *sweeps.values()), "final")
    place = drawn(axis)
    assert place.names == ["sarsa, a", "dqn, g"]
    assert place.shared_legend == ["sarsa, a", "dqn, g", "best: a = 0.1", "95 % interval"]
    first, second = place.lines
    assert (first["x"], first["y"]) == ([0.01, 0.1, 0.9], [10, 30, 20])
    assert (second["x"], second["y"]) == ([0.9, 0.95, 1], [1, 2, 3])
    assert [line["colour"] for line in place.lines] == [BLUE, ORANGE]
    assert {line["marker"] for line in place.lines} == {"o"}
    assert [band["colour"] for band in place.bands] == [BLUE, ORANGE]
    assert place.bands[0]["ends"] == {0.01: (9, 12), 0.1: (29, 32), 0.9: (19, 22)}
    assert axis.collections[-1].get_offsets().tolist() == [[0.1, 30]]  # the ring
    assert place.title == "lake"
    assert place.labels == ("value of the parameter (log scale)", "return of the final policy")
    assert axis.get_xscale() == "log"
    assert axis.get_xticks().tolist() == [0.01, 0.1, 0.9, 0.95, 1]


@pytest.mark.parametrize(
    ("values", "scale", "words"),
    [
        ([0.1, 0.5, 0.9], "linear", "n"),
        ([0, 5, 49], "linear", "n"),
        ([0, 1, 50], "symlog", "n (log scale beyond 1)"),
        ([1, 10, 100], "log", "n (log scale)"),
        ([-1, 0, 100], "linear", "n"),
        ([0, 0, 0], "linear", "n"),
    ],
)
def test_an_axis_of_values_says_what_scale_it_has(axes, made_up, values, scale, words):
    (axis,) = axes()
    one = sweep("n", values, [1, 2, 3])
    draw_sweeps(axis, {"alone": one}, ranked(made_up, one), "final")
    assert (axis.get_xscale(), axis.get_xlabel()) == (scale, words)


@pytest.mark.parametrize(("metric", "dark"), [("final", "30"), ("regret", "10")])
def test_a_heat_map_has_its_values_in_its_cells(axes, made_up, metric, dark):
    (axis,) = axes()
    means = np.array([[10.0, 30.0], [20.0, np.nan]])
    grid = Grid(("a", "e"), ["1", "2"], ["3", "4"], means, [["p", "q"], ["r", ""]])
    known = zip("pqr", means.ravel(), strict=False)
    found = sorted([made_up.agent(*one) for one in known], key=lambda a: a.agent != "q")
    draw_grid(axis, grid, "lake", made_up.environment(found), metric)
    texts = {text.get_text(): (text.get_position(), text.get_color()) for text in axis.texts}
    assert {text: place for text, (place, _) in texts.items()} == {
        "10": (0, 0),
        "30": (1, 0),
        "20": (0, 1),
    }
    assert [text for text, (_, colour) in texts.items() if colour == "white"] == [dark]
    (frame,) = axis.patches
    assert frame.get_center().tolist() == pytest.approx([1, 0])
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["3", "4"]
    assert (axis.get_ylabel(), axis.get_xlabel()) == ("a", "e")
    assert axis.get_ylim() == (1.5, -0.5)  # the first row on top


def test_blocks_have_an_average_a_minimum_and_a_maximum(axes, drawn):
    (axis,) = axes()
    rows = pd.DataFrame(
        {"episode": [5, 10], "average": [2, 3], "minimum": [0, 1], "maximum": [8, 9]}
    )
    draw_blocks(axis, rows, MARKS["first"])
    place = drawn(axis)
    assert [line["y"] for line in place.lines] == [[2, 3], [0, 1], [8, 9]]
    assert {tuple(line["x"]) for line in place.lines} == {(5, 10)}
    assert [line["style"] for line in place.lines] == ["-", ":", "--"]
    assert {line["colour"] for line in place.lines} == {ORANGE}
    assert place.title == "first"
    assert place.labels == ("episode", "return")


THRESHOLDS = np.array([0.0, 0.5, 1.0])
PROFILES = {
    "second": Band(np.array([1, 0.8, 0.25]), np.array([0.9, 0.7, 0]), np.array([1, 0.9, 0.5])),
    "first": Band(np.array([0.5, 0.25, 0]), np.array([0.25, 0, 0]), np.array([0.75, 0.5, 0.1])),
}
OVERALL = OverallAnalysis({}, {}, THRESHOLDS, PROFILES)


def test_a_profile_for_each_agent(axes, drawn):
    (axis,) = axes()
    draw_profiles(axis, OVERALL, MARKS)
    place = drawn(axis)
    assert place.names == ["second", "first"]
    assert place.shared_legend == ["second", "first", "95 % interval"]
    assert {tuple(line["x"]) for line in place.lines} == {(0, 0.5, 1)}
    assert [line["y"] for line in place.lines] == [[1, 0.8, 0.25], [0.5, 0.25, 0]]
    assert [line["colour"] for line in place.lines] == [BLUE, ORANGE]
    assert [band["colour"] for band in place.bands] == [BLUE, ORANGE]
    assert place.bands[0]["ends"] == {0: (0.9, 1), 0.5: (0.7, 0.9), 1: (0, 0.5)}
    assert place.bands[1]["ends"] == {0: (0.25, 0.75), 0.5: (0, 0.5), 1: (0, 0.1)}
    assert place.title == "Performance profiles over environments"
    assert place.labels == ("score", "share of runs with a higher score")
    assert place.axes.get_ylim() == (0, 1.02)
    assert place.axes.yaxis.get_major_formatter()(0.5) == "50%"


# --- which figures there are, and their files ----------------------------------------------------


@pytest.fixture
def series(made_up, tmp_path):
    """Two agents on a lake and on an island, where one of them was swept over."""
    agents = (made_up.agent("first", 90.0), made_up.agent("second", 40.0))
    places = [made_up.environment(agents, label) for label in ("lake", "island")]
    analysis = made_up.analysis(places, ["second", "first"], tmp_path, overall=OVERALL)
    swept_over = {"swept": Sweep("γ", curve([0.1, 0.2, 0.3], [1, 2, 3]), ("second", "first", "-"))}
    return StudySeries(
        analysis,
        agent_marks(analysis.study),
        tuple(
            EnvironmentSeries(place, learning_curves(), run_series(made_up), None, swept)
            for place, swept in zip(places, ({}, swept_over), strict=True)
        ),
    )


BLOCKS = pd.DataFrame(
    {
        "environment": ["lake", "lake", "lake", "island"],
        "agent": ["first", "first", "second", "first"],
        "episode": [5, 10, 5, 5],
        "average": [1, 2, 3, 4],
        "minimum": [0, 0, 0, 0],
        "maximum": [9, 9, 9, 9],
    }
)


def test_every_environment_has_its_figures(series, canvases, tmp_path):
    paths = write_figures(series, BLOCKS)
    kinds = ("learning_curves", "intervals", "episodes")
    assert [path.name for path in paths] == [
        f"{name}.{suffix}"
        for name in (
            *(f"lake_{kind}" for kind in kinds),
            *(f"island_{kind}" for kind in ("sweep", *kinds)),
            "performance_profiles",
        )
        for suffix in ("png", "svg")
    ]
    assert {path.parent for path in paths} == {tmp_path / "figures"}
    assert set(canvases) == {path.stem for path in paths}


def test_files_hold_what_their_names_say(series, drawn, canvases):
    write_figures(series, BLOCKS)

    def shown(name):
        return [drawn(place) for place in canvases[name]]

    for place in ("lake", "island"):
        left, right = shown(f"{place}_learning_curves")
        assert (left.title, right.title) == (f"{place}: evaluations", "training episodes")
        assert left.names[:2] == ["first", "second"]
        (runs,) = shown(f"{place}_intervals")
        assert runs.title == f"{place}; the line is the optimum"
        assert len(runs.lines) == 7
    first, second = shown("lake_episodes")[:2]
    assert (first.title, second.title) == ("first", "second")
    assert (first.lines[0]["y"], second.lines[0]["y"]) == ([1, 2], [3])
    assert first.shared_legend == ["average", "minimum", "maximum"]
    (alone,) = shown("island_episodes")
    assert alone.lines[0]["y"] == [4]
    (swept_over,) = shown("island_sweep")
    assert (swept_over.title, swept_over.names) == ("island", ["swept"])
    assert swept_over.labels[0] == "γ"
    (profiles,) = shown("performance_profiles")
    assert profiles.names == ["second", "first"]


def test_an_agent_has_one_colour_in_all_figures(series, drawn, canvases):
    """The order of the study says which, and not that of the ranks."""
    write_figures(series, None)
    colours = {
        (line["label"], line["colour"])
        for places in canvases.values()
        for place in places
        for line in drawn(place).lines
        if line["label"] in MARKS
    }
    assert colours == {("second", BLUE), ("first", ORANGE)}
    assert not [name for name in canvases if "episodes" in name]


def test_too_many_agents_make_no_lines(series, made_up, tmp_path):
    agents = [made_up.agent(f"agent {n}", float(-n)) for n in range(15)]
    one = series.environments[1]
    many = made_up.environment(agents, "island")
    swept_over = {"swept": replace(one.sweeps["swept"], labels=tuple(a.agent for a in agents[:3]))}
    crowded = EnvironmentSeries(many, one.curves, one.runs, None, swept_over)
    analysis = made_up.analysis([many], [agent.agent for agent in agents], tmp_path)
    found = write_figures(StudySeries(analysis, series.marks, (crowded,)), None)
    assert [path.name for path in found] == [f"island_sweep.{suffix}" for suffix in ("png", "svg")]


def test_marks_go_through_colours_and_dashes_together(made_up):
    labels = [f"agent {n}" for n in range(9)]
    marks = agent_marks(made_up.study(labels))
    assert list(marks) == labels
    assert [mark.colour for mark in marks.values()] == [0, 1, 2, 3, 4, 5, 6, 0, 1]
    assert [mark.dash for mark in marks.values()] == [*DASHES, *DASHES, "solid"]
    assert [mark.shape for mark in marks.values()] == [0] * 7 + [1] * 2
    many = agent_marks(made_up.study([f"agent {n}" for n in range(28)])).values()
    assert len({(mark.colour, mark.dash) for mark in many}) == 28
    styles = [line_style(Mark("a", 2, dash)) for dash in DASHES]
    assert [style["linestyle"] for style in styles] == ["-", "--", "-.", ":"]
    assert {style["color"] for style in styles} == {GREEN}


def test_an_interval_that_is_not_known_is_not_drawn(axes, drawn, made_up):
    """A single seed has none."""
    (axis,) = axes()
    alone = AgentRuns(
        "first", made_up.estimate(5.0, math.nan, math.nan), np.arange(1), np.array([5.0])
    )
    draw_runs(axis, [alone], made_up.environment(), "area", MARKS)
    dots, bar, mean = drawn(axis).lines
    assert dots["x"] == mean["x"] == [5]
    assert all(math.isnan(end) for end in bar["x"])
