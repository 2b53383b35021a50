"""Text to the letter, pictures by what must and must not differ, and the window.

Some pictures are held against those of tests/envs/pictures, which somebody has looked at. One that
has changed is written to the folder that the failure names: look at it, and if it is right put it
in the place of the old one.
"""

import copy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pygame
import pytest
from PIL import Image

from rl_yardstick.envs import drawing
from rl_yardstick.envs.bandits import BernoulliBandit, GaussianBandit, ReplayBandit
from rl_yardstick.envs.drawing import Bar, Bars, BarsRenderer, GridRenderer, Scene
from rl_yardstick.envs.mine_maze import MineMazeEnv
from rl_yardstick.envs.warehouse import WarehouseEnv

UP, DOWN, LEFT, RIGHT = range(4)
SHOWN_BY_CHARTS = "BernoulliBandit", "RandomWalk"
HERE = Path(__file__).parent
LOG = HERE / "uniform_log.csv"
# Another release of pygame may smooth edges and letters otherwise: that much is no change.
LEVELS, SHARE = 40, 0.0005


def shown(env, *actions):
    """What an environment shows after some actions."""
    env.reset(seed=0)
    for action in actions:
        env.step(action)
    return env.render()


def test_text_of_a_map():
    env = WarehouseEnv(desc=["..G", ".#.", "S.."], render_mode="ansi")
    assert shown(env, RIGHT, RIGHT, RIGHT) == "(right)\n..G\n.#.\nS*R\n"
    assert shown(env, RIGHT, RIGHT, UP, UP) == "(up)\n..R\n.#*\nS**\n"
    assert shown(env) == "(start)\n..G\n.#.\nR..\n"
    maze = MineMazeEnv(desc=["SPPM", "...G"], render_mode="ansi")
    assert shown(maze, RIGHT, DOWN) == "(down)\nS*PM\n.R.G\n"


def test_a_picture_fits_belongs_to_the_caller_and_is_as_before_after_reset():
    large = ["S" + "." * 85, *["." * 86] * 84, "." * 85 + "G"]
    for rows, shape in ((["S..G"], (64, 256, 3)), (large, (946, 946, 3))):
        drawn = shown(WarehouseEnv(desc=rows, render_mode="rgb_array"), RIGHT)
        assert (drawn.shape, drawn.dtype) == (shape, np.uint8)
    env = MineMazeEnv(desc=["P..", ".SM", "..G"], render_mode="rgb_array")
    before = shown(env)
    driven = [shown(env, action) for action in (UP, DOWN, LEFT, RIGHT)]
    # Each way it looks where it goes.
    assert len({picture.tobytes() for picture in (before, *driven)}) == 5
    corners = before[:64, :64], shown(env, UP, LEFT, RIGHT)[:64, :64]  # its power is collected
    assert [(each == drawing.ORANGE).all(axis=2).any() for each in corners] == [True, False]
    again = shown(env)
    assert np.array_equal(again, before)
    again[:] = 0
    assert np.array_equal(shown(env), before)


# Values on both sides of zero, a mark beyond them, and no value.
ARMS = [Bar("arm 0", 1.25, "2 pulls", 1.0), Bar("arm 1", -0.5, "1 pulls", -1.0, is_latest=True)]
ARMS += [Bar("arm 2", None, "-", 2.0)]
BARS = Bars.fitting("pull 3: arm 1, reward -0.5", ARMS, [1.25, -1.0, 2.0])
SCENES = {
    # Every thing there is; a trail that bends; a power source that was collected.
    "map": Scene(("SP#M", "...G", "M.P#"), 6, [(0, 1), (1, 5), (5, 6)], [1], 3),
    # A robot on the mine that it has driven down to.
    "burst": Scene(("S.", "M#"), 2, [(0, 2)], [], 1),
}


@pytest.mark.parametrize("name", [*SCENES, "arms"])
def test_a_picture_is_as_it_was(name, tmp_path):
    if name == "arms":
        found = BarsRenderer(10, "arms").pixels(BARS)
    else:
        found = GridRenderer(SCENES[name].rows, 10, "a map").pixels(SCENES[name])
    Image.fromarray(found).save(tmp_path / f"{name}.png", optimize=True)
    known = np.asarray(Image.open(HERE / "pictures" / f"{name}.png").convert("RGB"))
    assert found.shape == known.shape
    changed = (np.abs(found.astype(np.int64) - known) > LEVELS).any(axis=2)
    assert changed.mean() <= SHARE, f"{changed.mean():.2%} of {tmp_path}/{name}.png has changed"


def test_the_window_shows_the_picture_and_closes():
    env = gym.make("envs:Warehouse-v0", render_mode="human", desc=["S.G"])
    env.reset(seed=0)
    copied = copy.deepcopy(env)
    env.step(RIGHT)
    window = pygame.display.get_surface()
    assert pygame.display.get_caption()[0] == "Warehouse-v0"
    silent = WarehouseEnv(desc=["S.G"], render_mode="rgb_array")
    found = pygame.surfarray.array3d(window).swapaxes(0, 1)
    assert np.array_equal(found, shown(silent, RIGHT))
    silent.close()  # which leaves the other's window alone
    assert pygame.display.get_surface() is not None
    env.close()
    bandit, walk = (gym.make(f"{name}-v0", render_mode="human") for name in SHOWN_BY_CHARTS)
    for other in (env, copied, bandit, walk):  # a copy opens a window of its own
        assert pygame.display.get_surface() is None
        other.reset()
        assert pygame.display.get_surface() is not None
        other.close()


def test_text_of_bandits():
    env = BernoulliBandit([0.0, 0.5, 1.0], render_mode="ansi")
    assert shown(env, 0, 2, 2) == (
        "pull 3: arm 2, reward 1\n"
        "  arm 0       1 pulls, mean   0.000, true now 0.000  |\n"
        "  arm 1       0 pulls, mean       -, true now 0.500                      |\n"
        "> arm 2       2 pulls, mean   1.000, true now 1.000  "
        "=======================================|\n"
    )
    assert shown(env).startswith("no pull yet\n")
    # Of a replay only matched pulls count.
    text = shown(ReplayBandit(LOG, render_mode="ansi"), *[0] * 7)
    row = "> context 0 (next), arm 0       2 pulls, mean   0.625  ="
    assert text.startswith(f"pull 4: arm 0, reward 0.25\n{row}")
    # Means are shown as they are now.
    env = GaussianBandit([1.0, -1.0], drift_std=0.5, render_mode="ansi")
    text = shown(env, 0)
    assert all(f"true now {mean:.3f}" in text for mean in env.means[0])
