"""Text to the letter, pictures by the pixels that must and must not differ, and the window."""

import copy
import io
import itertools
import pickle
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray

from envs import drawing
from envs.drawing import MAX_SIDE
from envs.grid import GridWorld
from envs.mine_maze import MineMazeEnv
from envs.warehouse import WarehouseEnv, random_warehouse

UP, DOWN, LEFT, RIGHT = range(4)
Picture = NDArray[np.uint8]


def picture(env: GridWorld, *actions: int) -> Picture:
    env.reset(seed=0)
    for action in actions:
        env.step(action)
    drawn = env.render()
    assert isinstance(drawn, np.ndarray)
    return drawn


def cell(drawn: Picture, row: int, column: int, size: int = 64) -> Picture:
    return drawn[row * size : (row + 1) * size, column * size : (column + 1) * size]


def has(drawn: Picture, colour: drawing.Colour) -> bool:
    return bool((drawn == colour).all(axis=2).any())


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_text() -> None:
    env = WarehouseEnv(desc=["..G", ".#.", "S.."], render_mode="ansi")
    env.reset(seed=0)
    assert env.render() == "(start)\n..G\n.#.\nR..\n"
    env.step(RIGHT)
    assert env.render() == "(right)\n..G\n.#.\nSR.\n"
    env.step(RIGHT)
    env.step(RIGHT)
    assert env.render() == "(right)\n..G\n.#.\nS*R\n"
    env.step(UP)
    env.step(UP)
    assert env.render() == "(up)\n..R\n.#*\nS**\n"
    env.reset()
    assert env.render() == "(start)\n..G\n.#.\nR..\n"


def test_text_of_a_maze() -> None:
    env = MineMazeEnv(desc=["SPPM", "...G"], render_mode="ansi")
    env.reset(seed=0)
    for action in (RIGHT, DOWN):
        env.step(action)
    assert env.render() == "(down)\nS*PM\n.R.G\n"


def test_text_of_a_large_map_shows_what_is_near() -> None:
    rows = ["." * 300] * 200
    rows[100] = "." * 150 + "S" + "." * 149
    rows[199] = "." * 299 + "G"
    env = WarehouseEnv(desc=rows, render_mode="ansi")
    env.reset(seed=0)
    text = env.render()
    assert isinstance(text, str)
    title, *shown = text.splitlines()
    assert title == "(start) rows 80-119, columns 100-199"
    assert [len(row) for row in shown] == [100] * 40
    assert shown[20] == "." * 50 + "R" + "." * 49
    env.s = 200 * 300 - 2
    text = env.render()
    assert isinstance(text, str)
    title, *shown = text.splitlines()
    assert title == "(start) rows 160-199, columns 200-299"
    assert shown[-1].endswith("..RG")


def test_text_has_colour_on_a_terminal_unless_opted_out(monkeypatch: pytest.MonkeyPatch) -> None:
    env = MineMazeEnv(desc=["S.G", "PM."], render_mode="ansi")
    env.reset(seed=0)
    env.step(RIGHT)
    plain = "(right)\nSRG\nPM.\n"
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdout", Terminal())
    styled = {
        letter: f"\x1b[{code}m{letter}\x1b[0m"
        for letter, code in zip("SRGPM", ("36", "1;37;44", "1;32", "1;33", "1;31"), strict=True)
    }
    assert env.render() == "(right)\n" + "".join(styled.get(c, c) for c in plain[8:])
    monkeypatch.setenv("NO_COLOR", "")
    assert env.render() != plain
    monkeypatch.setenv("NO_COLOR", "1")
    assert env.render() == plain
    monkeypatch.delenv("NO_COLOR")
    monkeypatch.setenv("TERM", "dumb")
    assert env.render() == plain
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert env.render() == plain


def test_shape_and_type() -> None:
    drawn = picture(WarehouseEnv(render_mode="rgb_array"))
    assert (drawn.shape, str(drawn.dtype)) == ((640, 640, 3), "uint8")
    assert picture(WarehouseEnv(desc=["S..G"], render_mode="rgb_array")).shape == (64, 256, 3)


@pytest.mark.parametrize(
    ("n_rows", "n_columns", "shape"),
    [
        (16, 16, (1024, 1024)),
        (50, 20, (1000, 400)),
        (85, 85, (1020, 1020)),
        (86, 86, (946, 946)),
        (1000, 1000, (1000, 1000)),
        (1500, 300, (1024, 204)),
        (1, 3000, (1, 1024)),
    ],
)
def test_pictures_stay_within_their_size(
    n_rows: int, n_columns: int, shape: tuple[int, int]
) -> None:
    text = "S" + "." * (n_rows * n_columns - 2) + "G"
    rows = [text[i : i + n_columns] for i in range(0, len(text), n_columns)]
    drawn = picture(WarehouseEnv(desc=rows, render_mode="rgb_array"), RIGHT)
    assert drawn.shape == (*shape, 3)
    assert max(shape) <= MAX_SIDE


def test_different_things_look_different_without_colour_too() -> None:
    """Mean difference in brightness between any two of the things a cell can hold."""
    maze = picture(MineMazeEnv(desc=["SMP.G", "....."], render_mode="rgb_array"), DOWN)
    shelf = picture(WarehouseEnv(desc=["S#G", "..."], render_mode="rgb_array"), DOWN)
    cells = [cell(maze, 0, column) for column in range(5)] + [cell(shelf, 0, 1), cell(maze, 1, 0)]
    grey = [thing @ (0.299, 0.587, 0.114) for thing in cells]
    for one, other in itertools.combinations(grey, 2):
        assert np.abs(one - other).mean() > 8


def test_the_robot_is_drawn_where_it_is_and_faces_where_it_goes() -> None:
    env = WarehouseEnv(desc=["...", ".S.", "..G"], render_mode="rgb_array")
    facing = {}
    for action in range(4):
        row, column = (1 + (-1, 1, 0, 0)[action], 1 + (0, 0, -1, 1)[action])
        drawn = picture(env, action)
        assert has(cell(drawn, row, column), drawing.INK)
        assert not has(cell(drawn, 1, 1), drawing.INK)
        facing[action] = cell(drawn, row, column)[20:44, 20:44]
    for one, other in itertools.combinations(facing.values(), 2):
        assert np.abs(one.astype(int) - other).mean() > 5


def test_the_way_walked_is_drawn_and_forgotten_at_reset() -> None:
    env = WarehouseEnv(desc=["....", "S..G"], render_mode="rgb_array")
    before = picture(env)
    drawn = picture(env, UP, RIGHT, RIGHT)
    trail = [
        [tuple(cell(drawn, 0, column)[y, x]) for y, x in ((32, 4), (32, 60), (60, 32))]
        for column in (0, 1)
    ]
    on, off = drawing.BLUE, drawing.FLOOR
    assert trail == [[off, on, on], [on, on, off]]
    assert np.array_equal(cell(drawn, 1, 2), cell(before, 1, 2))
    assert np.array_equal(picture(env), before)


def test_running_into_something_leaves_no_trail() -> None:
    env = WarehouseEnv(desc=["S#", ".G"], render_mode="rgb_array")
    env.reset(seed=0)
    env.step(RIGHT)
    after = env.render()
    env.reset()
    env._last_action = RIGHT
    assert np.array_equal(np.asarray(after), np.asarray(env.render()))


def test_power_is_gone_once_collected_and_back_at_reset() -> None:
    env = MineMazeEnv(desc=["SPG"], render_mode="rgb_array")
    assert has(cell(picture(env), 0, 1), drawing.ORANGE)
    assert not has(cell(picture(env, RIGHT, LEFT), 0, 1), drawing.ORANGE)
    assert has(cell(picture(env), 0, 1), drawing.ORANGE)


def test_a_mine_that_was_hit_goes_off() -> None:
    env = MineMazeEnv(desc=["SM", ".G"], render_mode="rgb_array")
    assert not has(picture(env), drawing.ORANGE)
    assert has(cell(picture(env, RIGHT), 0, 1), drawing.ORANGE)


def test_a_large_map_keeps_robot_goal_trail_and_shelves_visible() -> None:
    env = WarehouseEnv(desc=random_warehouse(200, 0.3, 1), render_mode="rgb_array")
    start = picture(env)
    env.reset(seed=0)
    distances = env.map.distances
    for _ in range(60):
        moves = [env.dynamics.move(env.s, direction) for direction in range(4)]
        env.step(int(np.argmin([distances[m.next_state] + 9 * m.bumped for m in moves])))
    drawn = env.render()
    assert isinstance(drawn, np.ndarray)
    assert has(drawn, drawing.SHELF_LIGHT)
    assert has(drawn[:28, -28:], drawing.GREEN)
    assert has(drawn[-28:, :28], drawing.SKY)
    blue = (drawn == drawing.BLUE).all(axis=2).sum() - (start == drawing.BLUE).all(axis=2).sum()
    # Sixty cells of five pixels, five wide, less what markers hide and bends share.
    assert blue > 60 * 5 * 5 * 0.6


def test_power_and_mines_of_a_large_map() -> None:
    rows = ["." * 200] * 198 + ["S" + "." * 9 + "P" + "." * 189, "M" * 199 + "G"]
    env = MineMazeEnv(desc=rows, render_mode="rgb_array")
    before, after = picture(env), picture(env, *[RIGHT] * 20)
    assert has(before[-5:], drawing.VERMILION)
    assert has(before, drawing.ORANGE)
    assert not has(after, drawing.ORANGE)
    assert has(picture(env), drawing.ORANGE)


def test_a_picture_belongs_to_the_caller() -> None:
    env = WarehouseEnv(render_mode="rgb_array")
    first = picture(env)
    first[:] = 0
    assert picture(env).max() == 255


def test_the_window_shows_the_picture_and_closes() -> None:
    env = gym.make("Warehouse-v0", render_mode="human", desc=["S.G"])
    env.reset(seed=0)
    env.step(RIGHT)
    window = pygame.display.get_surface()
    assert window is not None
    assert pygame.display.get_caption()[0] == "Warehouse-v0"
    shown = pygame.surfarray.array3d(window).swapaxes(0, 1)
    silent = WarehouseEnv(desc=["S.G"], render_mode="rgb_array")
    assert np.array_equal(shown, picture(silent, RIGHT))
    env.close()
    assert pygame.display.get_surface() is None
    env.reset()
    assert pygame.display.get_surface() is not None
    env.close()


def test_a_copy_of_a_shown_environment_opens_its_own_window() -> None:
    env = gym.make("Warehouse-v0", render_mode="human", desc=["S.G"])
    env.reset(seed=0)
    copies: list[gym.Env[Any, Any]] = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    env.close()
    for other in copies:
        assert pygame.display.get_surface() is None
        other.step(RIGHT)
        assert pygame.display.get_surface() is not None
        other.close()


def test_closing_an_environment_without_a_window_leaves_windows_alone() -> None:
    shown = gym.make("Warehouse-v0", render_mode="human", desc=["S.G"])
    shown.reset(seed=0)
    silent = WarehouseEnv(render_mode="rgb_array")
    picture(silent)
    silent.close()
    assert pygame.display.get_surface() is not None
    shown.close()
