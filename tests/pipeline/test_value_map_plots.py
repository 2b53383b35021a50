"""The picture of a value map: what is drawn where, and that every kind of map can be drawn."""

import numpy as np
import pytest
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from PIL import Image

from agents import load_algorithm
from pipeline import map_pictures as drawing
from pipeline.environments import make_training_env
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.value_maps import value_map
from pipeline.map_pictures import (
    decimals_for,
    draw_arrows,
    draw_ground,
    draw_numbers,
    draw_value_map,
    is_below,
    layer_name,
    mark_differing,
    policies_in,
    short_number,
    shown_layers,
)
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec

UP, DOWN, LEFT, RIGHT = range(4)
MINUS = "\N{MINUS SIGN}"
# The cells are 0 S, 1 free, 2 free; 3 free, 4 shelf, 5 goal.
CORNER = {"desc": ["S..", ".#G"], "max_episode_steps": 10}


def map_of(env_id, actions=None, **env_kwargs):
    """The map of a table that is zero, so that its policy is action 0, or of given actions."""
    entry = {"n_timesteps": 1, "env_kwargs": env_kwargs}
    spec = TrainSpec("qlearning", env_id, split(entry), entry, seed=0)
    agent = load_algorithm("qlearning")("QTablePolicy", make_training_env(spec, None), seed=0)
    if actions is not None:
        agent.policy.q_tables[0, range(len(actions)), actions] = 1.0
    return value_map(exact_evaluator(spec), agent)


@pytest.fixture
def corner():
    found = map_of("Warehouse-v0", [RIGHT, LEFT, DOWN, LEFT, UP, UP], **CORNER)
    return policies_in(found, 0)


@pytest.fixture
def axes():
    return Figure().subplots()


def test_frames_stand_where_agent_and_optimum_part(corner, axes):
    for policy in corner:
        mark_differing(axes, policy, cell=36)
        centres = [segment[:4].mean(axis=0) for segment in axes.collections[-1].get_segments()]
        # Columns across, rows down: cells 1 and 3.
        np.testing.assert_allclose(centres, [(1, 0), (0, 1)])


def test_what_is_worth_less_than_the_scale_shows_is_hatched(corner, axes):
    scale, colours = Normalize(97, 100), LinearSegmentedColormap.from_list("", ["blue", "red"])
    for policy, expected in zip(corner, ([(0, 0), (1, 0), (0, 1)], []), strict=True):
        draw_ground(axes, policy, scale, colours)
        hatched = axes.collections[-1]
        assert hatched.get_hatch() == "////"
        corners = [path.vertices.min(axis=0) + 0.5 for path in hatched.get_paths()]
        np.testing.assert_array_equal(np.reshape(corners, (-1, 2)), np.reshape(expected, (-1, 2)))
    # Of the optimum, whose lowest value is below the start and whose highest above the goal.
    ground = axes.collections[-2].get_array()
    assert ground[1, 0].tolist() == [0, 0, 1]
    assert ground[0, 2].tolist() == [1, 0, 0]


def test_rounding_is_not_below_the_scale():
    scale = Normalize(0.3, 0.7)
    values = np.array([0.3, 0.1 + 0.2 - 1e-15, 0.2999, 0.8])
    assert is_below(values, scale).tolist() == [False, False, True, False]


def arrows(axes):
    """Middle and direction of every arrow, with how strong it is."""
    return [
        (round(x + u / 2, 6), round(y + v / 2, 6), np.sign(u), np.sign(v), quiver.get_alpha())
        for quiver in axes.collections
        for (x, y), u, v in zip(quiver.XY, quiver.U, quiver.V, strict=True)
    ]


def test_arrows_show_what_is_done_and_where_the_agent_comes_to(corner, axes):
    draw_arrows(axes, corner[0], 0.08, with_numbers=False)
    assert sorted(arrows(axes)) == [
        (0, 0, 1, 0, 1.0),
        (0, 1, -1, 0, 0.45),
        (1, 0, -1, 0, 1.0),
        (2, 0, 0, 1, 0.45),
    ]


def test_an_action_that_stays_is_a_ring(axes):
    found = map_of("WindyGridworld-v0", [8] * 70, moves="king_and_stay")
    draw_arrows(axes, policies_in(found, 0)[0], 0.04, with_numbers=False)
    rings = [rings for rings in axes.collections if isinstance(rings, PatchCollection)]
    boxes = [path.get_extents() for drawn in rings for path in drawn.get_paths()]
    centres = {(round((box.x0 + box.x1) / 2), round((box.y0 + box.y1) / 2)) for box in boxes}
    # The start and the cells around it, and not the goal.
    assert {(0, 3), (0, 4), (1, 3)} <= centres
    assert (7, 3) not in centres


def test_several_best_actions_set_out_from_the_middle(axes):
    square = map_of("Warehouse-v0", desc=["..G", "...", "S.."])
    draw_arrows(axes, policies_in(square, 0)[1], 0.04, with_numbers=False)
    from_start = [
        (tuple(xy), np.sign(u), np.sign(v))
        for quiver in axes.collections
        for xy, u, v in zip(quiver.XY, quiver.U, quiver.V, strict=True)
        if tuple(xy) == (0, 2)
    ]
    assert sorted(from_start) == [((0, 2), 0, -1), ((0, 2), 1, 0)]


def test_numbers_are_the_values(corner, axes):
    numbers = (["-10", "-10", "100", "-10"], ["98", "99", "100", "97"])
    for policy, expected in zip(corner, numbers, strict=True):
        before = len(axes.texts)
        draw_numbers(axes, policy, 8, decimals=0)
        texts = [text.get_text() for text in axes.texts[before:]]
        assert texts == [text.replace("-", MINUS) for text in expected]
        places = [text.get_position() for text in axes.texts[before:]]
        assert [(x, round(y)) for x, y in places] == [(0, 0), (1, 0), (2, 0), (0, 1)]


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (79.0, 0, "79"),
        (-1000.0, 0, "-1000"),
        (0.744, 2, "0.74"),
        (-0.004, 2, "0.00"),
        (-0.006, 2, "-0.01"),
        (57.64, 1, "57.6"),
        (-718.7, 1, "-719"),
        (99.46, 1, "99.5"),
        (99.6, 2, "100"),
        (9999.4, 2, "9999"),
        (9999.6, 0, "10k"),
        (-27_427.0, 0, "-27k"),
        (999_499.0, 0, "999k"),
        (-999_500.0, 0, "-1.0M"),
        (0.0, 0, "0"),
    ],
)
def test_numbers_are_short(value, decimals, text):
    assert short_number(value, decimals) == text.replace("-", MINUS)


def test_whole_values_need_no_decimals():
    assert decimals_for(map_of("Warehouse-v0")) == 0
    assert decimals_for(map_of("Warehouse-v0", slip=0.1)) == 1
    assert decimals_for(map_of("FrozenLake-v1")) == 2


def test_of_a_maze_the_layers_are_drawn_that_somebody_comes_to():
    # Always up: the agent stays on the start, and the best way collects power.
    found = map_of("MineMaze-v0")
    assert shown_layers(found) == [0, 1]
    names = [layer_name(found.layout, layer) for layer in (0, 1, 5)]
    assert names == [
        "nothing collected",
        "power collected at row 2, column 4",
        "power collected at row 2, column 4; row 6, column 2",
    ]
    agent, optimum = policies_in(found, 1)
    assert optimum.visited[9]
    assert agent.matters[9]
    assert not policies_in(found, 0)[0].matters[9]


@pytest.mark.parametrize("desc", [["S..", ".#G"], ["S" + "." * 11, "." * 11 + "G"]])
def test_rows_and_columns_count_from_one_as_pages_and_advice_do(desc, monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr(drawing, "write_png", lambda figure, path: figures.append(figure))
    found = map_of("Warehouse-v0", desc=desc)
    draw_value_map(tmp_path / "map.png", "title", found)
    panel = figures[0].axes[0]
    goal = len(desc) * len(desc[0]) - 1
    shown = [
        dict(zip(axis.get_ticklocs().tolist(), texts, strict=True))
        for axis, texts in (
            (panel.yaxis, [text.get_text() for text in panel.get_yticklabels()]),
            (panel.xaxis, [text.get_text() for text in panel.get_xticklabels()]),
        )
    ]
    row, column = divmod(goal, len(desc[0]))
    expected = f"row {shown[0][row]}, column {shown[1][column]}"
    assert found.layout.place_name(goal) == expected == f"row 2, column {len(desc[0])}"


def test_no_more_than_four_layers_are_drawn():
    # From the start there is a prize to the right, bit 0, and one below, bit 2; then any others.
    found = map_of("MineMaze-v0", desc=["SPP", "PPP", "..G"], slip=0.9, power_reward=2)
    assert shown_layers(found) == [0, 1, 4, 3]


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "is_wide"),
    [
        ("Warehouse-v0", {}, True),
        ("Warehouse-v0", {"slip": 0.1, "random_start": True}, True),
        ("Warehouse-v0", {"desc": ["SG"]}, False),
        ("RandomWarehouse-v0", {"size": 50}, True),
        ("MineMaze-v0", {}, False),
        ("FrozenLake-v1", {}, True),
        ("FrozenLake-v1", {"map_name": "8x8"}, True),
        ("CliffWalking-v1", {}, True),
    ],
)
def test_every_kind_of_map_can_be_drawn(env_id, env_kwargs, is_wide, tmp_path):
    draw_value_map(tmp_path / "map.png", "a title", map_of(env_id, **env_kwargs))
    with Image.open(tmp_path / "map.png") as image:
        image.load()
        assert image.format == "PNG"
        width, height = image.size
    assert (width > height) == is_wide
    assert max(width, height) < 2000
    assert [path.name for path in tmp_path.iterdir()] == ["map.png"]
