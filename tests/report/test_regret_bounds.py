"""What theory says of bandits beforehand."""

import math

import gymnasium as gym
import pytest

import envs  # noqa: F401  # registers the bandits
from report.series import auer_bound, best_expected_reward, best_of_normals, lai_robbins_slope

COINS = (0.2, 0.5, 0.75)


def test_auers_bound():
    """(8 / .55 + 8 / .25) ln n + (1 + pi^2 / 3) (.55 + .25), which is 432.1 at 10,000."""
    assert float(auer_bound(COINS, 10_000)) == pytest.approx(432.1, abs=0.05)
    at_once = 0.8 * (1 + math.pi**2 / 3)
    assert auer_bound(COINS, [1, math.e]) == pytest.approx([at_once, at_once + 8 / 0.55 + 8 / 0.25])
    assert float(auer_bound((0.5, 0.5), 10)) == 0


def test_lai_and_robbins_slope():
    assert lai_robbins_slope(COINS) == pytest.approx(2.564, abs=0.0005)
    # By hand for a pair: .25 / (.5 ln(.5 / .75) + .5 ln(.5 / .25)).
    by_hand = 0.25 / (0.5 * math.log(2 / 3) + 0.5 * math.log(2))
    assert lai_robbins_slope((0.5, 0.75)) == pytest.approx(by_hand)


def test_best_of_normals():
    """Closed forms for two and three; 1.5388 for the testbed's ten."""
    assert best_of_normals(1) == pytest.approx(0, abs=1e-9)
    assert best_of_normals(2) == pytest.approx(1 / math.sqrt(math.pi))
    assert best_of_normals(3) == pytest.approx(1.5 / math.sqrt(math.pi))
    assert best_of_normals(10) == pytest.approx(1.5388, abs=5e-5)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "expected"),
    [
        ("BernoulliBandit-v0", {}, 0.75),
        ("SegmentBandit-v0", {}, 0.3 * 0.25 + 0.7 * 0.12),
        ("GaussianBandit-v0", {"means": [1.0, 3.0, 2.0]}, 3.0),
        ("GaussianBandit-v0", {"mean_loc": 4.0, "n_arms": 2}, 4 + 1 / math.sqrt(math.pi)),
        ("GaussianBandit-v0", {"means": [0.0, 0.0], "drift_std": 0.1}, None),
        ("LinearBandit-v0", {}, None),
    ],
)
def test_best_expected_reward(env_id, kwargs, expected):
    env = gym.make(env_id, **kwargs)
    env.reset(seed=0)
    best = best_expected_reward(env)
    env.close()
    assert best == (None if expected is None else pytest.approx(expected))
