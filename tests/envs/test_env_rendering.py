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
from rl_yardstick.envs.bandits.bandit import Tally, render_chart
from rl_yardstick.envs.drawing import ChartRenderer, GridRenderer, Scene
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


def count(drawn, colour):
    """How many pixels have a colour."""
    return int((drawn == colour).all(axis=2).sum())


# --- maps as text ---------------------------------------------------------------------------------


def test_text_of_a_map():
    env = WarehouseEnv(desc=["..G", ".#.", "S.."], render_mode="ansi")
    assert shown(env, RIGHT, RIGHT, RIGHT) == "(right)\n..G\n.#.\nS*R\n"
    assert shown(env, RIGHT, RIGHT, UP, UP) == "(up)\n..R\n.#*\nS**\n"
    assert shown(env) == "(start)\n..G\n.#.\nR..\n"
    maze = MineMazeEnv(desc=["SPPM", "...G"], render_mode="ansi")
    assert shown(maze, RIGHT, DOWN) == "(down)\nS*PM\n.R.G\n"


# --- maps as pictures -----------------------------------------------------------------------------


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
    collected = shown(env, UP, LEFT, RIGHT)
    assert count(before[:64, :64], drawing.ORANGE) > 0 == count(collected[:64, :64], drawing.ORANGE)
    again = shown(env)
    assert np.array_equal(again, before)
    again[:] = 0
    assert np.array_equal(shown(env), before)


def arms_of_two_contexts():
    """A few pulls of some of the arms, and means on both sides of zero."""
    tally = Tally.empty(2, 9)
    for i in range(27):
        if i % 9 != 1:
            tally.add(i % 2, i % 9, 0.25 * (i % 7) - 0.5)
    return render_chart(tally, np.linspace(-1, 2, 18).reshape(2, 9), 1)


SCENES = {
    # Every thing there is; a trail that bends; a power source that was collected.
    "map": Scene(("SP#M", "...G", "M.P#"), 6, [(0, 1), (1, 5), (5, 6)], [1], 3),
    # A robot on the mine that it has driven down to.
    "burst": Scene(("S.", "M#"), 2, [(0, 2)], [], 1),
}


@pytest.mark.parametrize("name", [*SCENES, "arms"])
def test_a_picture_is_as_it_was(name, tmp_path):
    if name == "arms":
        found = ChartRenderer(10, "arms").pixels(arms_of_two_contexts())
    else:
        found = GridRenderer(SCENES[name].rows, 10, "a map").pixels(SCENES[name])
    Image.fromarray(found).save(tmp_path / f"{name}.png", optimize=True)
    known = np.asarray(Image.open(HERE / "pictures" / f"{name}.png").convert("RGB"))
    assert found.shape == known.shape
    changed = (np.abs(found.astype(np.int64) - known) > LEVELS).any(axis=2)
    assert changed.mean() <= SHARE, f"{changed.mean():.2%} of {tmp_path}/{name}.png has changed"


# --- windows --------------------------------------------------------------------------------------


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


# --- bandits --------------------------------------------------------------------------------------


def test_text_of_bandits():
    env = BernoulliBandit([0.0, 0.5, 1.0], render_mode="ansi")
    assert shown(env, 0, 2, 2) == (
        "pull 3: arm 2, reward 1\n"
        "  arm    pulls  observed  true now\n"
        "    0        1     0.000     0.000  |\n"
        "    1        0         -     0.500                |\n"
        ">   2        2     1.000     1.000  =============================|\n"
    )
    assert shown(env).startswith("no pull yet\n")
    # Of a replay what matched counts.
    text = shown(ReplayBandit(LOG, render_mode="ansi"), *[0] * 7)
    assert text.startswith("pull 4: arm 0, reward 0.25\ncontext 0 (next)\n")
    assert ">   0        2     0.625  ==============================\n" in text
    # Means are shown as they are now.
    env = GaussianBandit([1.0, -1.0], drift_std=0.5, render_mode="ansi")
    text = shown(env, 0)
    assert all(f"{mean:10.3f}" in text for mean in env.means[0])
