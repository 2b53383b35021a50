"""Figures of bandits by pull, worked on paper, and the means that runs share."""

import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401  # registers the bandits
from experiments.bandits import MAX_POINTS, PullStatistics, points_of, pull_statistics, true_means

# Arm 0 costs .3 a pull and arm 1 nothing; two runs of four pulls.
ARMS = np.array([[0, 1, 1, 0], [1, 1, 0, 1]], dtype=np.int16)
REWARDS = np.array([[1, 0, 1, 1], [0, 1, 1, 0]], dtype=np.float32)
REGRETS = np.where(ARMS == 0, 0.3, 0.0)


def test_two_runs_of_four_pulls_on_paper():
    found = pull_statistics(ARMS, REWARDS, REGRETS, None, 2)
    assert found.pulls.tolist() == [1, 2, 3, 4]
    assert found.reward == pytest.approx([0.5, 0.5, 1, 0.5])
    assert found.optimal == pytest.approx([0.5, 1, 0.5, 0.5])
    assert found.regret == pytest.approx([0.15, 0, 0.15, 0.15])
    # The sums are .3 .3 .3 .6 and 0 0 .3 .3.
    assert found.cumulative_regret == pytest.approx([0.15, 0.15, 0.3, 0.45])
    assert found.cumulative_regret_sem == pytest.approx([0.15, 0.15, 0, 0.15])
    low, lower, median, upper, high = found.cumulative_regret_quantiles
    assert [low[0], lower[0], median[0], upper[0], high[0]] == pytest.approx(
        [0.015, 0.075, 0.15, 0.225, 0.285]
    )
    assert median == pytest.approx([0.15, 0.15, 0.3, 0.45])
    # The first run has pulled arm 0 most after pulls 1, 2 and 4, where ties go to the first arm.
    assert found.simple_regret == pytest.approx([0.15, 0.15, 0, 0.15])
    assert found.total_reward.tolist() == [3, 2]
    assert found.total_regret == pytest.approx([0.6, 0.3])
    assert found.shares == pytest.approx(np.array([[3 / 8, 5 / 8]]))
    assert found.context_regret == pytest.approx(np.array([[0.3, 0]]))
    for name in ("estimates", "estimates_std", "true_means", "moments", "posteriors"):
        assert getattr(found, name).size == 0, name


def test_contexts_on_paper():
    """Arm 1 alone, which costs .4 in context 0 and nothing in context 1; there are three."""
    contexts = np.array([[0, 1, 0, 1]])
    regrets = np.where(contexts == 0, 0.4, 0.0)
    arms, rewards = np.ones((1, 4), dtype=np.int16), np.zeros((1, 4), dtype=np.float32)
    found = pull_statistics(arms, rewards, regrets, contexts, 2, 3)
    # Each context weighs as often as it was seen.
    assert found.simple_regret == pytest.approx([0.4, 0.4 / 2, 0.4 * 2 / 3, 0.4 / 2])
    assert np.array_equal(found.shares, [[0, 1], [0, 1], [math.nan] * 2], equal_nan=True)
    expected = [[math.nan, 0.4], [math.nan, 0], [math.nan] * 2]
    assert found.context_regret == pytest.approx(np.array(expected), nan_ok=True)
    assert found.cumulative_regret_sem.tolist() == [0, 0, 0, 0]  # of a single run


def test_estimates_leave_out_arms_that_were_never_tried():
    estimates = np.array([[[1.0, math.nan]], [[3.0, math.nan]], [[math.nan, math.nan]]])
    arms, rewards = np.zeros((3, 2), dtype=np.int16), np.zeros((3, 2), dtype=np.float32)
    found = pull_statistics(arms, rewards, np.zeros((3, 2)), None, 2, estimates=estimates)
    assert np.array_equal(found.estimates, [[2, math.nan]], equal_nan=True)
    assert np.array_equal(found.estimates_std, [[1, math.nan]], equal_nan=True)


@pytest.mark.parametrize("n", [1, 2, MAX_POINTS, MAX_POINTS + 1, 1000, 100_000])
def test_points(n):
    points = points_of(n)
    assert points[0] == 1
    assert points[-1] == n
    assert (np.diff(points) > 0).all()
    assert len(points) <= MAX_POINTS
    assert points[:100].tolist() == list(range(1, min(n, 100) + 1))


def test_between_points_nothing_is_lost():
    rng = np.random.default_rng(0)
    arms = rng.integers(3, size=(4, 1000)).astype(np.int16)
    rewards = rng.normal(size=(4, 1000)).astype(np.float32)
    regrets = np.array([0.0, 0.1, 0.7])[arms]
    found = pull_statistics(arms, rewards, regrets, None, 3)
    widths = np.diff(found.pulls, prepend=0)
    assert len(found.pulls) < 1000
    assert found.reward @ widths == pytest.approx(found.total_reward.mean())
    assert found.optimal @ widths == pytest.approx((arms == 0).sum(axis=1).mean())
    assert found.regret @ widths == pytest.approx(found.total_regret.mean())
    assert found.cumulative_regret == pytest.approx(np.cumsum(found.regret * widths))
    index = int(np.searchsorted(found.pulls, 500))
    upto = found.pulls[index]
    most = [np.bincount(row[:upto], minlength=3).argmax() for row in arms]
    assert found.simple_regret[index] == pytest.approx(np.array([0, 0.1, 0.7])[most].mean())


def test_saved_and_loaded(tmp_path):
    found = pull_statistics(ARMS, REWARDS, REGRETS, None, 2, true_means=np.array([[0.2, 0.5]]))
    found.save(tmp_path / "file.npz")
    again = PullStatistics.load(tmp_path / "file.npz")
    for field in dataclasses.fields(PullStatistics):
        one, other = getattr(found, field.name), getattr(again, field.name)
        assert one.dtype == other.dtype
        assert np.array_equal(one, other), field.name
    assert [path.name for path in tmp_path.iterdir()] == ["file.npz"]


@pytest.mark.parametrize(
    ("env_id", "kwargs", "expected"),
    [
        ("BernoulliBandit-v0", {}, [[0.2, 0.5, 0.75]]),
        ("SegmentBandit-v0", {}, [[0.10, 0.25, 0.05], [0.12, 0.06, 0.05]]),
        ("GaussianBandit-v0", {"means": [1.0, 3.0]}, [[1, 3]]),
        ("GaussianBandit-v0", {}, None),
        ("GaussianBandit-v0", {"means": [0.0, 0.0], "drift_std": 0.1}, None),
        ("LinearBandit-v0", {}, None),
    ],
)
def test_means_that_all_runs_share(env_id, kwargs, expected):
    env = gym.make(env_id, **kwargs)
    found = true_means(env)
    env.close()
    assert (None if found is None else found.tolist()) == expected
