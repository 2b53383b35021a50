"""The mine maze: rewards worked by hand, its optimum by exhaustive search, what was collected."""

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.mine_maze import MineMazeEnv

UP, DOWN, LEFT, RIGHT = range(4)


def walk(env: MineMazeEnv, actions: list[int]) -> list[tuple[Any, ...]]:
    return [env.step(action) for action in actions]


def test_spaces_and_time_limit() -> None:
    env = gym.make("MineMaze-v0")
    assert env.observation_space == gym.spaces.Discrete(36 * 2**3)
    assert env.action_space == gym.spaces.Discrete(4)
    env.reset(seed=0)
    truncated = [env.step(UP)[3] for _ in range(100)]
    assert truncated == [False] * 99 + [True]


def test_rewards_worked_by_hand() -> None:
    env = MineMazeEnv()
    observation, info = env.reset(seed=0)
    assert (observation, info["position"]) == (0, (0, 0))
    # Off the map, then to the power at (1, 3) and back onto it, then onto the mine at (2, 3).
    steps = walk(env, [UP, RIGHT, RIGHT, DOWN, RIGHT, LEFT, RIGHT, DOWN])
    assert [step[1] for step in steps] == [-1, -1, -1, -1, 0, -1, -1, -101]
    assert [step[2] for step in steps] == [False] * 7 + [True]
    assert [step[4]["bumped"] for step in steps] == [True] + [False] * 7
    # The power at (1, 3) is the first of three: its bit counts 36 * 1.
    assert [step[0] for step in steps] == [0, 1, 2, 8, 36 + 9, 36 + 8, 36 + 9, 36 + 15]
    assert steps[-1][4]["is_success"] is False


def test_the_best_way_earns_91() -> None:
    env = MineMazeEnv()
    env.reset(seed=0)
    # Along the power at (1, 3).
    steps = walk(env, [RIGHT, RIGHT, DOWN, RIGHT, RIGHT, DOWN, DOWN, DOWN, DOWN, RIGHT])
    assert [step[1] for step in steps] == [-1, -1, -1, 0, -1, -1, -1, -1, -1, 99]
    assert sum(step[1] for step in steps) == 91
    assert (steps[-1][2], steps[-1][4]["is_success"]) == (True, True)
    assert env.s == 36 + 35


def test_91_is_the_best_return_of_100_steps() -> None:
    """By exhaustive search, from stepping out of every state once."""
    env = MineMazeEnv()
    target, reward, goes_on = (np.zeros((288, 4)) for _ in range(3))
    for state, action in itertools.product(range(288), range(4)):
        env.s = state
        _, reward[state, action], terminated, _, _ = env.step(action)
        target[state, action], goes_on[state, action] = env.s, not terminated
    values = np.zeros(288)
    best = []
    for _ in range(100):
        values = (reward + goes_on * values[target.astype(int)]).max(axis=1)
        best.append(values[0])
    assert best[-1] == 91
    assert best.index(91) + 1 == env.shortest_path_length == 10


def test_what_was_collected_is_forgotten_at_reset() -> None:
    env = MineMazeEnv(desc=["SPG"])
    for _ in range(2):
        assert env.reset(seed=0)[0] == 0
        assert env.step(RIGHT)[:2] == (3 + 1, 0.0)


def test_running_into_the_wall_on_a_collected_cell_collects_nothing_more() -> None:
    env = MineMazeEnv(desc=["SPG"], power_reward=5)
    env.reset(seed=0)
    assert [step[:2] for step in walk(env, [RIGHT, UP, DOWN, LEFT, RIGHT, RIGHT])] == [
        (4, 4.0),
        (4, -1.0),
        (4, -1.0),
        (3, -1.0),
        (4, -1.0),
        (5, 99.0),
    ]


def test_the_rewards_are_arguments() -> None:
    env = MineMazeEnv(
        ["SPG", "M.."], step_reward=-2, mine_reward=-5, power_reward=4, goal_reward=10
    )
    env.reset(seed=0)
    assert [step[1] for step in walk(env, [UP, RIGHT, RIGHT])] == [-2, 2, 8]
    env.reset()
    assert env.step(DOWN)[1:3] == (-7.0, True)


def test_bits_are_numbered_row_by_row() -> None:
    env = MineMazeEnv(desc=["SP", "PG"])
    env.reset(seed=0)
    assert [step[0] for step in walk(env, [RIGHT, LEFT, DOWN])] == [4 + 1, 4 + 0, 4 * 3 + 2]


def test_random_starts_leave_out_goal_mines_and_power() -> None:
    env = MineMazeEnv(desc=["S.P", ".MG", "..M", "MM."], random_start=True)
    distribution = env.initial_state_distrib
    assert distribution.shape == (24,)
    assert np.flatnonzero(distribution).tolist() == [0, 1, 3, 6, 7]


@st.composite
def mazes(draw: st.DrawFn) -> list[str]:
    """Small mazes with at most three cells of power, whether or not they can be solved."""
    n_rows, n_columns = draw(st.integers(1, 4)), draw(st.integers(2, 4))
    size = n_rows * n_columns
    letters = draw(st.lists(st.sampled_from("...M"), min_size=size, max_size=size))
    for cell in draw(st.lists(st.integers(0, size - 1), max_size=3)):
        letters[cell] = "P"
    start, goal = draw(st.lists(st.integers(0, size - 1), min_size=2, max_size=2, unique=True))
    letters[start], letters[goal] = "S", "G"
    return ["".join(letters[i : i + n_columns]) for i in range(0, size, n_columns)]


class Description:
    """The maze as it is described, on its text and with a set of what has been collected."""

    def __init__(self, rows: list[str], position: tuple[int, int]) -> None:
        self.rows = rows
        self.position = position
        self.collected: set[tuple[int, int]] = set()

    def step(self, action: int) -> tuple[int, bool, bool]:
        """Reward, whether the episode ends, whether the robot ran into the wall."""
        row = self.position[0] + {UP: -1, DOWN: 1}.get(action, 0)
        column = self.position[1] + {LEFT: -1, RIGHT: 1}.get(action, 0)
        if not (0 <= row < len(self.rows) and 0 <= column < len(self.rows[0])):
            return -1, False, True
        self.position = row, column
        letter = self.rows[row][column]
        bonus = {"M": -100, "G": 100, "P": 0 if self.position in self.collected else 1}
        if letter == "P":
            self.collected.add(self.position)
        return -1 + bonus.get(letter, 0), letter in {"M", "G"}, False

    def observation(self) -> int:
        width = len(self.rows[0])
        places = [divmod(i, width) for i, letter in enumerate("".join(self.rows)) if letter == "P"]
        mask = sum(1 << i for i, place in enumerate(places) if place in self.collected)
        row, column = self.position
        return row * width + column + width * len(self.rows) * mask


@given(mazes(), st.booleans(), st.integers(0, 2**32))
def test_any_maze_follows_the_rules(desc: list[str], random_start: bool, seed: int) -> None:
    try:
        env = MineMazeEnv(desc=desc, random_start=random_start)
    except ValueError as error:
        assert "cannot be reached" in str(error)  # noqa: PT017  # broken mazes have a test below
        return
    assert np.allclose(env.transition_model().prob.sum(axis=2), 1)
    expected = Description(desc, env.reset(seed=seed)[1]["position"])
    for action in np.random.default_rng(seed).integers(4, size=40).tolist():
        observation, reward, terminated, _, info = env.step(action)
        assert (reward, terminated, info["bumped"]) == expected.step(action)
        assert (observation, info["position"]) == (expected.observation(), expected.position)
        row, column = expected.position
        assert info["is_success"] is (desc[row][column] == "G")
        if terminated:
            expected = Description(desc, env.reset()[1]["position"])


def test_an_unsolvable_maze_is_refused() -> None:
    with pytest.raises(ValueError, match="at row 2, column 2 cannot be reached from the start at"):
        MineMazeEnv(desc=["SM", "MG"])
