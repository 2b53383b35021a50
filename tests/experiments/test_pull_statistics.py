"""The record of every pull that a training on a bandit leaves."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from envs.bandits import log_uniformly
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
