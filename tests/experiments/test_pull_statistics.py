"""The record of every pull that a training on a bandit leaves."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from envs.bandits import log_uniformly
from experiments.bandits import QUANTILES, PullStatistics, points_of, pull_statistics
from pipeline.pull_recording import PullRecorder, are_bandits

FIGURES = ("arms", "rewards", "expected_rewards", "regrets", "optimal", "matched")
MEANS = np.array([[0.10, 0.25, 0.05], [0.12, 0.06, 0.05]])


def recorded(algorithm, folder, env_id="SegmentBandit-v0", n_envs=2, pulls=100, **kwargs):
    env = make_vec_env(env_id, n_envs, seed=0)
    agent = algorithm(env=env, seed=0, **kwargs)
    agent.learn(pulls, callback=PullRecorder(folder))
    env.close()
    with np.load(folder / "pulls.npz") as file:
        return dict(file)


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    [
        (load_algorithm("ucb"), {}),
        (load_algorithm("qlearning"), {}),
        (load_algorithm("random"), {"policy": "RandomPolicy"}),
        (DQN, {"policy": "MlpPolicy", "learning_starts": 10, "train_freq": 1}),
        (PPO, {"policy": "MlpPolicy", "n_steps": 25, "batch_size": 25}),
    ],
)
def test_any_agent_leaves_its_pulls(algorithm, kwargs, tmp_path):
    pulls = recorded(algorithm, tmp_path, **kwargs)
    assert {name: array.shape for name, array in pulls.items()} == dict.fromkeys(
        (*FIGURES, "contexts"), (2, 50)
    )
    worth = MEANS[pulls["contexts"], pulls["arms"]]
    assert pulls["expected_rewards"] == pytest.approx(worth)
    assert pulls["regrets"] == pytest.approx(MEANS.max(axis=1)[pulls["contexts"]] - worth)
    assert np.array_equal(pulls["optimal"], pulls["regrets"] == 0)
    assert pulls["matched"].all()
    assert set(np.unique(pulls["rewards"])) <= {0.0, 1.0}
    assert [path.name for path in tmp_path.iterdir()] == ["pulls.npz"]


def test_contexts_that_are_vectors_are_left_out(tmp_path):
    pulls = recorded(load_algorithm("linucb"), tmp_path, "LinearBandit-v0", n_envs=1)
    assert "contexts" not in pulls
    assert pulls["arms"].shape == (1, 100)
    assert (pulls["regrets"] >= 0).all()


def test_a_log_knows_rewards_and_matches_alone(tmp_path):
    log_uniformly(gym.make("SegmentBandit-v0"), 300, 0, tmp_path / "log.csv")
    env = make_vec_env("ReplayBandit-v0", env_kwargs={"log": str(tmp_path / "log.csv")}, seed=0)
    agent = load_algorithm("ucb")(env=env, seed=0)
    agent.learn(300, callback=PullRecorder(tmp_path))
    env.close()
    with np.load(tmp_path / "pulls.npz") as file:
        pulls = dict(file)
    assert np.isnan(pulls["regrets"]).all()
    assert not pulls["optimal"].any()
    # Only what a log holds is learnt from: about one pull in three.
    assert 60 < pulls["matched"].sum() < 140
    assert agent.policy.counts.sum() == pulls["matched"].sum()
    assert agent.policy.sums.sum() == pulls["rewards"].sum()
    assert (pulls["rewards"][~pulls["matched"]] == 0).all()


def test_what_is_a_bandit():
    for env_id, expected in (("BernoulliBandit-v0", True), ("FrozenLake-v1", False)):
        env = make_vec_env(lambda env_id=env_id: gym.make(env_id))
        assert are_bandits(env) == expected
        env.close()


# --- summed up ------------------------------------------------------------------------------------


BY_CELL = np.array([[0, 8, 2], [4, 0, 1]])  # the regret of each arm in each of two contexts


@pytest.fixture(scope="module")
def many_pulls():
    """Three runs of so many pulls that the points thin out; regrets are whole numbers."""
    rng = np.random.default_rng(0)
    arms, contexts = rng.integers(3, size=(3, 450)), rng.integers(2, size=(3, 450))
    regrets = BY_CELL[contexts, arms].astype(np.float64)
    rewards = rng.integers(-3, 9, size=(3, 450)).astype(np.float64)
    return arms, rewards, regrets, contexts, pull_statistics(arms, rewards, regrets, contexts, 3, 2)


def test_every_figure_at_every_point_the_plain_way(many_pulls):
    _, rewards, regrets, _, found = many_pulls
    assert 300 >= len(found.pulls) > 200
    before = 0
    for i, pull in enumerate(found.pulls.tolist()):
        block, sums = slice(before, pull), regrets[:, :pull].sum(axis=1)
        assert found.reward[i] == pytest.approx(rewards[:, block].mean())
        assert found.regret[i] == pytest.approx(regrets[:, block].mean())
        assert found.optimal[i] == pytest.approx((regrets[:, block] == 0).mean())
        assert found.cumulative_regret[i] == pytest.approx(sums.mean())
        assert found.cumulative_regret_sem[i] == pytest.approx(sums.std(ddof=1) / np.sqrt(3))
        quantiles = np.quantile(sums, QUANTILES)
        assert found.cumulative_regret_quantiles[:, i] == pytest.approx(quantiles)
        before = pull
    assert found.total_reward.tolist() == rewards.sum(axis=1).tolist()
    assert found.total_regret.tolist() == regrets.sum(axis=1).tolist()


def test_simple_regret_and_shares_the_plain_way(many_pulls):
    arms, _, _, contexts, found = many_pulls
    for i, pull in enumerate(found.pulls.tolist()):
        total = 0.0
        for run in range(3):
            for context in range(2):
                here = contexts[run, :pull] == context
                most = np.bincount(arms[run, :pull][here], minlength=3).argmax()
                total += BY_CELL[context, most] * here.mean()
        assert found.simple_regret[i] == pytest.approx(total / 3)
    assert found.context_regret.tolist() == BY_CELL.tolist()
    for context in range(2):
        counts = np.bincount(arms[contexts == context], minlength=3)
        assert found.shares[context] == pytest.approx(counts / counts.sum())


def test_the_points_thin_out_from_the_hundredth_pull_on():
    assert points_of(1).tolist() == [1]
    assert points_of(300).tolist() == list(range(1, 301))
    for n_pulls in (301, 1000, 10**6):
        points = points_of(n_pulls)
        assert points[:101].tolist() == list(range(1, 102))
        assert points[-1] == n_pulls
        assert 200 < len(points) <= 300
        assert (np.diff(points) > 0).all()
        # Later ones lie further apart, but for rounding.
        assert (np.diff(np.diff(points)) >= -1).all()


def test_estimates_leave_out_runs_that_have_none():
    estimates = np.array([[[1.0, np.nan]], [[4.0, 2.0]], [[np.nan, 5.0]]])
    one = np.zeros((3, 1))
    found = pull_statistics(one.astype(np.int64), one, one, None, 2, estimates=estimates)
    assert found.estimates.tolist() == [[2.5, 3.5]]
    assert found.estimates_std.tolist() == [[1.5, 1.5]]


def test_statistics_are_read_as_they_were_written(tmp_path):
    arms = np.array([[0, 1, 1], [1, 1, 0]])
    given = {"moments": (1, 3), "posteriors": np.arange(16.0).reshape(2, 2, 1, 2, 2)}
    true_means = np.array([[0.1, 0.2]])
    written = pull_statistics(arms, arms * 1.0, arms * 0.5, None, 2, true_means=true_means, **given)
    written.save(tmp_path / "statistics.npz")
    read = PullStatistics.load(tmp_path / "statistics.npz")
    for name, value in vars(written).items():
        np.testing.assert_array_equal(getattr(read, name), value)
    assert read.moments.tolist() == [1, 3]
    # Of the first run alone.
    assert read.posteriors.tolist() == given["posteriors"][0].tolist()
    assert read.true_means.tolist() == [[0.1, 0.2]]
