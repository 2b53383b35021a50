"""MABWiser behind our interface, and our agents against it."""

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the bandits
from agents import load_algorithm
from agents.bandits.runs import run_batch, run_one_by_one

AGENTS = {
    "mabwiser_epsilon_greedy": "BernoulliBandit-v0",
    "mabwiser_ucb1": "GaussianBandit-v0",
    "mabwiser_thompson": "BernoulliBandit-v0",
    "mabwiser_linucb": "SegmentBandit-v0",
}


def make(name, env_id=None, seed=0, **kwargs):
    env = make_vec_env(env_id or AGENTS[name], seed=seed)
    return load_algorithm(name)(env=env, seed=seed, **kwargs)


@pytest.mark.parametrize(
    ("ours", "theirs", "env_id", "kwargs"),
    [
        ("ucb", "mabwiser_ucb1", "BernoulliBandit-v0", {}),
        ("ucb", "mabwiser_ucb1", "GaussianBandit-v0", {"c": 0.5}),
        ("linucb", "mabwiser_linucb", "LinearBandit-v0", {}),
        ("linucb", "mabwiser_linucb", "SegmentBandit-v0", {"alpha": 0.5}),
    ],
)
def test_ours_and_theirs_pull_the_same_arms(ours, theirs, env_id, kwargs):
    """3,000 pulls: the update is the same to the last digit that a decision can hang on."""
    args = env_id, {"pulls": 3000}, [0]
    first = run_batch(ours, {**kwargs, "tie_breaking": "first"}, *args)
    second = run_one_by_one(theirs, kwargs, *args)
    assert np.array_equal(first.arms, second.arms)
    assert np.array_equal(first.rewards, second.rewards)
    assert len(set(first.arms[0].tolist())) > 2


@pytest.mark.parametrize("name", AGENTS)
def test_a_saved_agent_goes_on_as_it_would_have(name, tmp_path):
    model = make(name).learn(120)
    model.save(tmp_path / "agent.zip")
    loaded = load_algorithm(name).load(tmp_path / "agent.zip")
    assert np.array_equal(loaded.policy.parts, model.policy.parts)
    for agent in (model, loaded):
        agent.set_env(make_vec_env(AGENTS[name], seed=5))
        agent.learn(150, reset_num_timesteps=False)
    assert np.array_equal(loaded.policy.parts, model.policy.parts)
    assert loaded.rng.bit_generator.state == model.rng.bit_generator.state


@pytest.mark.parametrize("name", AGENTS)
def test_an_untrained_agent_can_be_saved_and_asked(name, tmp_path):
    model = make(name)
    model.save(tmp_path / "agent.zip")
    loaded = load_algorithm(name).load(tmp_path / "agent.zip")
    assert loaded.predict(0)[0] == loaded.predict(0, deterministic=True)[0] == 0


@pytest.mark.parametrize("name", AGENTS)
def test_same_seed_same_training(name):
    first, second = (make(name).learn(150) for _ in range(2))
    assert np.array_equal(first.policy.parts, second.policy.parts)
    assert not np.array_equal(make(name, seed=1).learn(150).policy.parts, first.policy.parts)


def test_predictions():
    model = make("mabwiser_linucb").learn(2000)
    best = model.predict(np.array([0, 1]), deterministic=True)[0]
    # Core users click on the second treatment, casual ones on the first.
    assert best.tolist() == [1, 0]
    before = model.policy.parts
    assert model.predict(np.array([0, 1, 1, 0]))[0].shape == (4,)
    assert np.array_equal(model.policy.parts, before)
    coins = make("mabwiser_thompson").learn(500)
    assert coins.predict(0, deterministic=True)[0] == 2
    judged = coins.policy.judged(np.ones((1, 1)))[0]
    won, lost = coins.policy.parts.T
    assert judged == pytest.approx(won / (won + lost))


def test_ucb1_pulls_every_arm_once():
    result = run_one_by_one("mabwiser_ucb1", {}, "GaussianBandit-v0", {}, [3], pulls=12)
    assert result.arms[0, :10].tolist() == list(range(10))


def test_rewards_that_are_no_coins_are_refused():
    with pytest.raises(ValueError, match="MABWiserThompson as it is set learns from rewards that"):
        make("mabwiser_thompson", "GaussianBandit-v0").learn(10)
