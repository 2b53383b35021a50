"""Maps, and the worlds on them: steps worked by hand, rules spelt out, optima by search."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rl_yardstick.envs.grid import GridMap
from rl_yardstick.envs.mine_maze import MineMazeEnv
from rl_yardstick.envs.textbook.grids import DynaMazeEnv
from rl_yardstick.envs.warehouse import WarehouseEnv, random_warehouse

UP, DOWN, LEFT, RIGHT = range(4)
ROWS = ["..G", ".#.", "S.."]


def walk(env, letters):
    """A column each: observations, rewards, whether it terminated, and what ``info`` says."""
    steps = [env.step("UDLR".index(letter)) for letter in letters]
    return [[step[i] for step in steps] for i in (0, 1, 2, 4)]


def test_a_map_is_read_from_rows_text_and_files(tmp_path):
    path, marked = tmp_path / "map.txt", tmp_path / "marked.txt"
    path.write_text("\n".join(ROWS))
    marked.write_bytes(("\ufeff" + "\r\n".join(ROWS) + "\r\n\r\n").encode())
    for desc in (ROWS, "\n".join(ROWS) + "\n", path, str(path), marked):
        grid_map = GridMap.read(desc, known="#.SG", passable=".S")
        assert (grid_map.rows, grid_map.codes) == (tuple(ROWS), b"..G.#.S..")
        assert grid_map.start == 6
        assert grid_map.distances.tolist() == [2, 1, 0, 3, -1, 1, 4, 3, 2]


BROKEN = [  # in a file where it is bytes
    ([], "the map is empty"),
    (["S..", "..", "..G"], "row 2 has 2 cells, row 1 has 3"),
    (["...", "..G"], "the map has 0 starts S and 1 goals G, it must have one start, and a goal"),
    (["..S", "S.G"], "the map has 2 starts S and 1 goals G"),
    (["S..", "..."], "the map has 1 starts S and 0 goals G"),
    (["S..", ".é.", "..G"], "unknown letter 'é' at row 2, column 2; known are # . S G"),
    (["S#.", "#..", "..G"], "goal at row 3, column 3 cannot be reached from the start at row 1"),
    ("missing.txt", "cannot read the map file missing.txt: No such file or directory"),
    (["S" + "." * 5000 + "G"] * 5000, "has 25,010,000 cells, more than 16,777,216"),
    (b"S.\n?G\n", r"map\.txt: unknown letter '\?' at row 2, column 1"),
    (b"S.\xff\xfe.G", r"map\.txt: 'utf-8' codec can't decode byte"),
]
BROKEN_MAZES = [
    (["S#G"], r"unknown letter '#' at row 1, column 2; known are S \. M P"),
    (["SMG"], "the goal at row 1, column 3 cannot be reached"),
    (["S" + "P" * 25 + "G"], r"has 27 cells, 25 of them to collect: these make 27 \* 2\*\*25"),
]


@pytest.mark.parametrize(("desc", "message"), BROKEN + BROKEN_MAZES)
def test_a_broken_map_is_refused_in_one_line(desc, message, tmp_path):
    kind = WarehouseEnv if (desc, message) in BROKEN else MineMazeEnv
    if isinstance(desc, bytes):
        (tmp_path / "map.txt").write_bytes(desc)
        desc = tmp_path / "map.txt"
    with pytest.raises(ValueError, match=message) as refused:
        kind(desc=desc)
    assert "\n" not in str(refused.value)


def test_a_maze_has_room_for_so_many_powers_and_the_nearest_goal_counts():
    assert MineMazeEnv(desc=["S" + "P" * 18 + "G"]).dynamics.n_states == 20 * 2**18
    assert WarehouseEnv(desc=["G..S.G", "......"]).shortest_path_length == 2


def test_slip_goes_to_both_sides_in_the_stated_order():
    middle = WarehouseEnv(desc=["...", ".S.", "..G"], slip=0.2).P[4]
    reached = {UP: (1, 3, 5), DOWN: (7, 3, 5), LEFT: (3, 1, 7), RIGHT: (5, 1, 7)}
    for action, cells in reached.items():
        chances = zip((0.8, 0.1, 0.1), cells, strict=True)
        assert middle[action] == [(prob, cell, -1.0, False) for prob, cell in chances]
    # Slipping against a shelf costs as much as driving there.
    sliding = WarehouseEnv(desc=["#", "S", "G"], slip=1)
    expected = [(0.0, 1, -1.0, False), (0.5, 1, -100.0, False), (0.5, 2, 100.0, True)]
    assert sliding.P[1][LEFT] == expected


def test_random_starts_leave_out_goals_what_is_cut_off_and_what_holds_something():
    env = WarehouseEnv(desc=["S.G#.", "..###"], random_start=True)
    assert env.initial_state_distrib.tolist() == [0.25, 0.25, 0, 0, 0, 0.25, 0.25, 0, 0, 0]
    env = MineMazeEnv(desc=["S.P", ".MG", "..M", "MM."], random_start=True)
    assert env.initial_state_distrib.shape == (24,)
    assert np.flatnonzero(env.initial_state_distrib).tolist() == [0, 1, 3, 6, 7]


def test_what_is_observed():
    spaces = {
        "discrete": (gym.spaces.Discrete(15), [0, 6, 14]),
        "position": (gym.spaces.Box(0, 1, (2,), np.float32), [[0, 0], [0.5, 0.25], [1, 1]]),
        "one_hot": (gym.spaces.Box(0, 1, (15,), np.float32), np.eye(15)[[0, 6, 14]].tolist()),
    }
    for observation, (space, seen) in spaces.items():
        env = WarehouseEnv(desc=["S....", ".....", "....G"], observation=observation)
        assert env.observation_space == space
        batch = env.observation_of(np.array([0, 6, 14]))
        assert batch.tolist() == seen
        first, _ = env.reset(seed=0)
        assert np.asarray(first).tolist() == seen[0]
        assert observation == "discrete" or first.dtype == batch.dtype == np.float32
        assert np.asarray(walk(env, "DR")[0][-1]).tolist() == seen[1]


@st.composite
def maps(draw, letters):
    """Small maps, whether or not they can be solved, and with at most three cells of power."""
    n_rows, n_columns = draw(st.integers(1, 5)), draw(st.integers(2, 5))
    size = n_rows * n_columns
    found = draw(st.lists(st.sampled_from(letters), min_size=size, max_size=size))
    if "M" in letters:
        for cell in draw(st.lists(st.integers(0, size - 1), max_size=3)):
            found[cell] = "P"
    start, goal = draw(st.lists(st.integers(0, size - 1), min_size=2, max_size=2, unique=True))
    found[start], found[goal] = "S", "G"
    return ["".join(found[i : i + n_columns]) for i in range(0, size, n_columns)]


def rules(rows, position, collected, action, rewards):
    """What the descriptions of both worlds say: position, reward, end, and whether it bumped.

    ``rewards`` has what entering a letter earns, or driving against it; other steps earn that of
    an empty cell.
    """
    row = position[0] + {UP: -1, DOWN: 1}.get(action, 0)
    column = position[1] + {LEFT: -1, RIGHT: 1}.get(action, 0)
    if not (0 <= row < len(rows) and 0 <= column < len(rows[0])):
        return position, rewards["."], False, True
    letter = "." if (row, column) in collected else rows[row][column]
    place = position if letter == "#" else (row, column)
    return place, rewards.get(letter, rewards["."]), letter in "MG", letter == "#"


SIDES = {UP: (LEFT, RIGHT), DOWN: (LEFT, RIGHT), LEFT: (UP, DOWN), RIGHT: (UP, DOWN)}


@pytest.mark.parametrize("kind", [WarehouseEnv, MineMazeEnv])
@settings(max_examples=60)
@given(st.data(), st.sampled_from([0, 0.25, 1]), st.booleans(), st.integers(0, 2**32))
def test_any_map_that_can_be_solved_follows_the_rules(kind, data, slip, random_start, seed):
    rows = data.draw(maps("..#" if kind is WarehouseEnv else "...M"))
    try:
        kind(rows)
    except ValueError as error:
        assume("cannot be reached" not in str(error))
        raise
    step, shelf, mine, power, goal = data.draw(st.tuples(*[st.integers(-9, 9)] * 5))
    kwargs = {"step_reward": step, "goal_reward": goal, "slip": slip, "random_start": random_start}
    if kind is WarehouseEnv:
        rewards = {".": step, "#": shelf, "G": goal}
        env = kind(rows, shelf_reward=shelf, **kwargs)
    else:  # what is found there comes on top of the step
        rewards = {".": step, "M": step + mine, "P": step + power, "G": step + goal}
        env = kind(rows, mine_reward=mine, power_reward=power, **kwargs)
    model = env.transition_model()
    np.testing.assert_allclose(model.prob.sum(axis=2), 1)
    for state, action in np.ndindex(model.n_states, 4):
        move = env.dynamics.move(state, action)
        listed = (model.next_state, model.reward, model.terminated)
        assert tuple(array[state, action, 0] for array in listed) == move[:3]
    position, collected = env.reset(seed=seed)[1]["position"], set()
    assert random_start or rows[position[0]][position[1]] == "S"
    powers = [divmod(i, len(rows[0])) for i, letter in enumerate("".join(rows)) if letter == "P"]
    for action in np.random.default_rng(seed).integers(4, size=40).tolist():
        ways = (action, *SIDES[action]) if slip else (action,)
        possible = [rules(rows, position, collected, way, rewards) for way in ways]
        state, reward, terminated, _, info = env.step(action)
        position = info["position"]
        assert (position, reward, terminated, info["bumped"]) in possible
        collected |= {position} & set(powers)
        mask = sum(1 << i for i, place in enumerate(powers) if place in collected)
        row, column = position
        assert state == row * len(rows[0]) + column + len(rows) * len(rows[0]) * mask
        assert info["is_success"] is (rows[row][column] == "G")
        if terminated:
            position, collected = env.reset()[1]["position"], set()


def test_a_seed_names_a_map_for_good():
    expected = ["...##G", "#...#.", "#.....", "..##.#", "......", "S###.#"]
    assert random_warehouse(6, 0.4, 7) == expected
    found = [random_warehouse(10, 0.3, seed) for seed in range(20)]
    assert len({tuple(rows) for rows in found}) == 20
    assert 0.2 < np.mean([list("".join(rows)).count("#") for rows in found]) / 100 < 0.4
    # A full warehouse keeps all shelves but those on one shortest way of eleven cells.
    assert [str(random_warehouse(6, density)).count("#") for density in (0, 1)] == [0, 36 - 11]
    # Each can be solved, or it would be refused.
    assert all(WarehouseEnv(desc=rows).shortest_path_length >= 18 for rows in found)


@pytest.mark.parametrize("kwargs", [{"size": 50}, {"max_episode_steps": 10**6}], ids=str)
def test_an_episode_is_limited_by_ten_shortest_ways_unless_it_is_said_otherwise(kwargs):
    env = gym.make("envs:RandomWarehouse-v0", slip=0.1, **kwargs)
    limit = kwargs.get("max_episode_steps", 10 * env.unwrapped.shortest_path_length)
    again = gym.make(env.spec)
    assert env.spec.max_episode_steps == again.spec.max_episode_steps == limit
    assert again.unwrapped.rows == env.unwrapped.rows
    assert str(env).count("TimeLimit") == 1
    assert str(again) == str(env)


CHANGING = {"maze": "blocking", "changed": True}


def test_shortest_ways_of_the_mazes():
    mazes = itertools.product(("blocking", "shortcut"), (False, True))
    found = [DynaMazeEnv(maze=m, changed=changed).shortest_path_length for m, changed in mazes]
    assert found == [10, 16, 16, 10]
    env = DynaMazeEnv()
    assert (env.shortest_path_length, env.transition_model().n_states) == (14, 54)
    env.reset(seed=0)
    assert walk(env, "DDRRRRURRRRUUU")[1] == [0] * 13 + [1]


def test_a_maze_changes_once_after_so_many_steps_over_all_episodes():
    env = DynaMazeEnv(**CHANGING, change_after_steps=5)
    env.reset(seed=0)
    walk(env, "LLLL")
    env.reset()
    assert env.map.rows[3] == "########."
    walk(env, "L")
    assert env.map.rows[3] == ".########"
    env.reset()
    assert walk(env, "LLLUUUUU")[3][-1]["position"] == (0, 0)


def test_what_a_changing_maze_tells_is_of_the_moment():
    env = DynaMazeEnv(**CHANGING, change_after_steps=2, random_start=True, slip=0.25)
    env.reset(seed=0)
    before = env.P, env.initial_state_distrib
    env.s = 0
    walk(env, "UU")
    assert env.map.rows[3] == ".########"
    assert before[0] != env.P
    assert not np.array_equal(env.initial_state_distrib, before[1])
    assert env.dynamics.outcome_prob == (0.75, 0.125, 0.125)
