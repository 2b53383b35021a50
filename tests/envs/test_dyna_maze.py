"""The mazes of chapter 8, as they are and as they change."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

from envs.known_models import (
    action_masks_of_states,
    observations_of_states,
    success_outcomes,
    transition_model,
)
from envs.layout import grid_layout
from envs.textbook.dyna_maze import DynaMazeEnv

UP, DOWN, LEFT, RIGHT = range(4)
CHANGING = {"maze": "blocking", "changed": True}


@pytest.mark.parametrize(
    ("kwargs", "moves"),
    [
        ({}, 14),
        ({"maze": "blocking"}, 10),
        ({"maze": "blocking", "changed": True}, 16),
        ({"maze": "shortcut"}, 16),
        ({"maze": "shortcut", "changed": True}, 10),
    ],
)
def test_shortest_ways(kwargs, moves) -> None:
    env = DynaMazeEnv(**kwargs)
    assert env.shortest_path_length == moves
    assert env.transition_model().n_states == 54


def test_only_the_goal_is_worth_something() -> None:
    env = DynaMazeEnv()
    env.reset(seed=0)
    way = [DOWN] * 2 + [RIGHT] * 4 + [UP] + [RIGHT] * 4 + [UP] * 3
    steps = [env.step(action) for action in way]
    assert [step[1] for step in steps] == [0.0] * 13 + [1.0]
    assert steps[-1][2]
    assert steps[-1][4]["is_success"]


def walls(env) -> str:
    return env.map.rows[3]


def test_a_maze_changes_once_after_so_many_steps_over_all_episodes() -> None:
    env = DynaMazeEnv(**CHANGING, change_after_steps=5)
    env.reset(seed=0)
    for _ in range(4):
        env.step(LEFT)
    env.reset()
    assert walls(env) == "########."
    env.step(LEFT)
    assert walls(env) == ".########"
    env.reset()
    for _ in range(3):
        env.step(LEFT)
    positions = [env.step(UP)[4]["position"] for _ in range(5)]
    assert positions[-1] == (0, 0)


def test_it_waits_until_nobody_stands_where_a_wall_comes() -> None:
    env = DynaMazeEnv(**CHANGING, change_after_steps=1)
    env.reset(seed=0)
    env.s = 3 * 9 + 8
    env.steps_done = 1
    env.step(RIGHT)  # against the edge: the robot stays in the gap
    assert walls(env) == "########."
    env.step(UP)
    assert walls(env) == ".########"
    assert env.step(DOWN)[4]["bumped"]


def test_a_maze_that_changes_tells_no_model() -> None:
    env = gym.make("DynaMaze-v0", **CHANGING, change_after_steps=9)
    assert transition_model(env) is None
    assert observations_of_states(env) is None
    assert success_outcomes(env) is None
    assert action_masks_of_states(env) is None
    still = gym.make("DynaMaze-v0", **CHANGING)
    assert transition_model(still) is not None
    assert action_masks_of_states(still) is not None
    assert grid_layout(still).rows[3] == ".########"


def test_what_it_tells_is_of_the_moment_and_a_copy_goes_on_alike() -> None:
    env = DynaMazeEnv(**CHANGING, change_after_steps=2, random_start=True, slip=0.25)
    env.reset(seed=0)
    before = env.P, env.initial_state_distrib
    copied = pickle.loads(pickle.dumps(env))
    env.s = copied.s = 0
    for one in (env, copied):
        one.step(UP)
        one.step(UP)
        assert walls(one) == ".########"
        assert before[0] != one.P
        assert not np.array_equal(one.initial_state_distrib, before[1])
        assert one.dynamics.outcome_prob == (0.75, 0.125, 0.125)
    assert env.step(LEFT)[0] == copied.step(LEFT)[0]


def test_pictures_change_with_the_maze() -> None:
    env = DynaMazeEnv(**CHANGING, change_after_steps=1, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(DOWN)
    assert not np.array_equal(env.render()[200:256, 512:], first[200:256, 512:])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"maze": "block"}, "unknown maze 'block': did you mean 'blocking'"),
        ({"changed": True}, "changed: the maze 'dyna' never changes"),
        ({"maze": "blocking", "change_after_steps": 5}, "change_after_steps needs changed: true"),
        ({**CHANGING, "change_after_steps": 0}, "change_after_steps must be a whole number"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(wrong, message) -> None:
    with pytest.raises(ValueError, match=message):
        DynaMazeEnv(**wrong)
