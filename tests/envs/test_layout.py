"""States on the map: against maps and numbers written by hand, and against the moves themselves."""

import gymnasium as gym
import numpy as np
import pytest

from envs.known_models import transition_model
from envs.layout import action_names, grid_layout

UP, DOWN, LEFT, RIGHT = (-1, 0), (1, 0), (0, -1), (0, 1)

WORLDS = {
    "Warehouse": ("envs:Warehouse-v0", {}),
    "RandomWarehouse": ("envs:RandomWarehouse-v0", {"size": 7}),
    "MineMaze": ("envs:MineMaze-v0", {}),
    "FrozenLake": ("FrozenLake-v1", {"is_slippery": False}),
    "FrozenLake 8x8": ("FrozenLake-v1", {"is_slippery": False, "map_name": "8x8"}),
    "FrozenLake 2x3": ("FrozenLake-v1", {"is_slippery": False, "desc": ["SFH", "FFG"]}),
    "CliffWalking": ("CliffWalking-v1", {}),
    "DynaMaze": ("envs:DynaMaze-v0", {"maze": "blocking"}),
}


def layout_of(name):
    env_id, kwargs = WORLDS[name]
    return grid_layout(gym.make(env_id, **kwargs))


def test_the_warehouse():
    layout = layout_of("Warehouse")
    assert layout.rows[0] == "...#.....G"
    assert layout.rows[9] == "S........."
    assert layout.names == {"#": "shelf"}
    assert layout.moves == (UP, DOWN, LEFT, RIGHT)
    assert (layout.n_rows, layout.n_columns, layout.n_layers, layout.n_states) == (10, 10, 1, 100)
    assert layout.cells.tolist() == list(range(100))
    assert layout.layers.tolist() == [0] * 100


def test_the_frozen_lakes():
    layout = layout_of("FrozenLake")
    assert layout.rows == ("S...", ".X.X", "...X", "X..G")
    assert layout.names == {"X": "hole"}
    assert layout.moves == (LEFT, DOWN, RIGHT, UP)
    assert layout_of("FrozenLake 8x8").rows[2] == "...X...."
    layout = layout_of("FrozenLake 2x3")
    assert layout.rows == ("S.X", "..G")
    assert layout.cells.tolist() == [0, 1, 2, 3, 4, 5]


def test_the_cliff():
    layout = layout_of("CliffWalking")
    assert layout.rows == ("............",) * 3 + ("SXXXXXXXXXXG",)
    assert layout.names == {"X": "cliff"}
    assert layout.moves == (UP, RIGHT, DOWN, LEFT)


def test_a_field_with_wind():
    layout = grid_layout(gym.make("envs:WindyGridworld-v0", moves="king_and_stay"))
    assert layout.rows[3] == "S......G.."
    assert layout.n_states == 70
    assert layout.moves == (UP, DOWN, LEFT, RIGHT, (-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0))


def test_the_mine_maze_has_a_layer_for_each_set_of_powers():
    layout = layout_of("MineMaze")
    assert layout.rows == ("S..X..", ".X.P.X", ".X.X..", "...X.P", ".X...X", ".PX..G")
    assert layout.names == {"X": "mine", "P": "power"}
    assert layout.prizes == (9, 23, 31)
    assert (layout.n_layers, layout.n_states) == (8, 288)
    # Row 2, column 4, with the first and the last power collected: 16 + 36 * 0b101.
    assert (layout.cells[196], layout.layers[196]) == (16, 5)
    assert layout.collected_in(0) == ()
    assert layout.collected_in(5) == (9, 31)
    assert layout.rows_in(0) == layout.rows
    assert layout.rows_in(5) == ("S..X..", ".X...X", ".X.X..", "...X.P", ".X...X", "..X..G")


def test_wrappers_change_nothing():
    env = gym.wrappers.RecordEpisodeStatistics(gym.make("FrozenLake-v1"))
    assert grid_layout(env) == grid_layout(gym.make("FrozenLake-v1"))


@pytest.mark.parametrize("env_id", ["Taxi-v4", "CartPole-v1", "envs:BernoulliBandit-v0"])
def test_what_is_no_grid_has_no_layout(env_id):
    assert grid_layout(gym.make(env_id)) is None


@pytest.mark.parametrize("name", WORLDS)
def test_moves_lead_where_the_layout_says(name):
    env_id, kwargs = WORLDS[name]
    layout, model = layout_of(name), transition_model(gym.make(env_id, **kwargs))
    assert layout.n_states == model.n_states
    assert len(layout.moves) == model.n_actions
    letters = "".join(layout.rows)
    for state, action in zip(*np.nonzero(np.outer(model.reachable, [True] * 4)), strict=True):
        reached = model.next_state[state, action, 0]
        row, column = np.divmod(layout.cells[state], layout.n_columns) + np.array(
            layout.moves[action]
        )
        inside = 0 <= row < layout.n_rows and 0 <= column < layout.n_columns
        target = row * layout.n_columns + column if inside else layout.cells[state]
        if letters[target] == "#":
            target = layout.cells[state]
        if name == "CliffWalking" and letters[target] == "X":
            target = 36
        assert layout.cells[reached] == target
        if letters[target] == "P":
            assert target in layout.collected_in(layout.layers[reached])
        assert model.terminated[state, action, 0] == (letters[target] in "GX")
    assert {letters[start] for start in np.flatnonzero(model.initial)} == {"S"}


def test_actions_are_called_as_the_environment_says_or_by_their_moves():
    assert action_names(gym.make("FrozenLake-v1")) == ("left", "down", "right", "up")
    assert action_names(gym.make("envs:Warehouse-v0")) == ("up", "down", "left", "right")
    moves = action_names(gym.make("envs:JacksCarRental-v0"))
    assert (len(moves), moves[0], moves[5], moves[-1]) == (11, "move -5", "move +0", "move +5")
    assert action_names(gym.make("envs:WindyGridworld-v0"))[:4] == ("up", "down", "left", "right")
    assert action_names(gym.make("Taxi-v4")) == ()
