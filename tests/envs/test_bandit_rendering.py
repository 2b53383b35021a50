"""Bandits as text and as pictures."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from envs import drawing
from envs.bandits import BernoulliBandit, GaussianBandit, LinearBandit, ReplayBandit, SegmentBandit
from envs.bandits.bandit import Tally, render_chart, render_text
from envs.drawing import Box, Label

LOG = Path(__file__).parent / "uniform_log.csv"


def picture(env: gym.Env[Any, Any]) -> NDArray[np.uint8]:
    pixels = env.render()
    env.close()
    assert isinstance(pixels, np.ndarray)
    assert pixels.dtype == np.uint8
    return pixels


def has(pixels: NDArray[np.uint8], colour: drawing.Colour) -> int:
    """How many pixels have a colour."""
    return int((pixels == colour).all(axis=2).sum())


def test_text_of_coins() -> None:
    env = BernoulliBandit([0.0, 0.5, 1.0], render_mode="ansi")
    env.reset(seed=0)
    assert env.render() == (
        "no pull yet\n"
        "  arm    pulls  observed  true now\n"
        "    0        0         -     0.000  |\n"
        "    1        0         -     0.500                |\n"
        "    2        0         -     1.000                               |\n"
    )
    for arm in (0, 2, 2):
        env.step(arm)
    assert env.render() == (
        "pull 3: arm 2, reward 1\n"
        "  arm    pulls  observed  true now\n"
        "    0        1     0.000     0.000  |\n"
        "    1        0         -     0.500                |\n"
        ">   2        2     1.000     1.000  =============================|\n"
    )
    env.reset()
    assert str(env.render()).startswith("no pull yet\n")


def test_text_of_segments_counts_where_the_pull_was_made() -> None:
    env = SegmentBandit([0.0, 1.0], [[0.5, 0.5], [0.0, 1.0]], render_mode="ansi")
    env.reset(seed=0)
    env.step(1)
    assert env.render() == (
        "pull 1: arm 1, reward 1\n"
        "context 0\n"
        "  arm    pulls  observed  true now\n"
        "    0        0         -     0.500                |\n"
        "    1        0         -     0.500                |\n"
        "context 1 (next)\n"
        "  arm    pulls  observed  true now\n"
        "    0        0         -     0.000  |\n"
        ">   1        1     1.000     1.000  =============================|\n"
    )


def test_text_of_a_replay_counts_what_matched() -> None:
    env = ReplayBandit(LOG, render_mode="ansi")
    env.reset()
    for _ in range(7):
        env.step(0)
    assert env.render() == (
        "pull 4: arm 0, reward 0.25\n"
        "context 0 (next)\n"
        "  arm    pulls  observed\n"
        ">   0        2     0.625  ==============================\n"
        "    1        0         -\n"
        "context 1\n"
        "  arm    pulls  observed\n"
        "    0        2     0.500  ========================\n"
        "    1        0         -\n"
    )


def test_text_shows_means_as_they_are_now() -> None:
    env = GaussianBandit([1.0, -1.0], drift_std=0.5, render_mode="ansi")
    env.reset(seed=0)
    env.step(0)
    first, second = env.means[0]
    assert f"{first:10.3f}" in str(env.render())
    assert f"{second:10.3f}" in str(env.render())
    linear = LinearBandit(render_mode="ansi")
    linear.reset(seed=0)
    linear.step(0)
    for mean in linear.expected_rewards():
        assert f"{mean:10.3f}" in str(linear.render())


def test_of_many_arms_and_contexts_a_part_is_shown() -> None:
    tally = Tally.empty(20, 50)
    tally.add(10, 7, 1.0)
    text = render_text(tally, None, 10)
    titles = [line for line in text.splitlines() if line.startswith("context")]
    assert titles == ["context 8", "context 9", "context 10 (next)", "context 11"]
    assert text.count("... of 50 arms") == 4
    chart = render_chart(tally, None, 19)
    labels = [shape.text for shape in chart.shapes if isinstance(shape, Label)]
    assert "arms 0-39 of 50" in labels
    assert [label for label in labels if label.startswith("context")] == [
        f"context {i}" for i in range(16, 20)
    ]
    assert chart.size == (960, 40 + 4 * 248)


def test_a_bar_reaches_from_zero_to_the_observed_mean() -> None:
    tally = Tally.empty(1, 2)
    for reward in (1.0, 2.0):
        tally.add(0, 0, reward)
    tally.add(0, 1, -1.0)
    chart = render_chart(tally, np.array([[2.0, 1.0]]), 0)
    boxes = [shape for shape in chart.shapes if isinstance(shape, Box)]
    bars = [box for box in boxes if box.colour in {drawing.BLUE, drawing.DARK_BLUE}][1:]
    zero = next(box for box in boxes if box.colour == drawing.SHELF).corner[1]
    # The panel is 160 pixels high between the lowest value, -1, and the highest, 2.
    assert bars[0].corner[1] == pytest.approx(zero - 80)
    assert bars[0].size[1] == pytest.approx(81)
    assert bars[1].corner[1] == pytest.approx(zero)
    assert bars[1].size[1] == pytest.approx(160 / 3 + 1)
    assert [bar.colour for bar in bars] == [drawing.BLUE, drawing.DARK_BLUE]


def test_pictures_grow_with_arms_and_contexts_up_to_a_limit() -> None:
    sizes = {}
    for n_arms in (2, 10, 100):
        env = GaussianBandit(n_arms=n_arms, render_mode="rgb_array")
        env.reset(seed=0)
        sizes[n_arms] = picture(env).shape
    assert sizes == {2: (288, 374, 3), 10: (288, 710, 3), 100: (288, 960, 3)}
    segments = SegmentBandit(render_mode="rgb_array")
    segments.reset(seed=0)
    assert picture(segments).shape == (536, 374, 3)


def test_a_picture_shows_true_means_at_once_and_bars_after_pulls() -> None:
    env = BernoulliBandit([0.2, 1.0], render_mode="rgb_array")
    env.reset(seed=0)
    before = picture(env)
    assert has(before, drawing.ORANGE) > 300
    assert has(before, drawing.DARK_BLUE) == 0
    env.step(1)
    after = picture(env)
    assert has(after, drawing.DARK_BLUE) > 1000
    assert np.array_equal(picture(env), after)


def test_what_is_not_known_is_not_drawn() -> None:
    env = ReplayBandit(LOG, render_mode="rgb_array")
    env.reset()
    env.step(0)
    pixels = picture(env)
    assert has(pixels, drawing.ORANGE) == 0
    assert has(pixels, drawing.DARK_BLUE) > 1000


def test_without_a_mode_nothing_is_counted() -> None:
    env = BernoulliBandit()
    env.reset(seed=0)
    env.step(0)
    assert env._tally.counts.sum() == 0
    with pytest.warns(UserWarning, match="made without render_mode"):
        assert env.render() is None
