"""The dynamics of the bandits: their draws one by one, and what is known of them exactly."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.seeding import np_random

import envs  # noqa: F401 (registers the environments)
from envs.bandits import BernoulliBandit, GaussianBandit, LinearBandit
from envs.known_models import observations_of_states, success_outcomes, time_limit, transition_model
from envs.wrappers import ScaleReward
from mdp import baseline_return, finite_horizon_optimum, policy_return


def arms_to_pull(n, n_arms):
    return np.random.default_rng(99).integers(n_arms, size=n).tolist()


# --- draws ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("drift_std", [0.0, 0.25])
@pytest.mark.parametrize("given_means", [None, [0.5, 0.5, 0.5]], ids=["redrawn", "given"])
def test_draws_of_gaussian_bandits(given_means, drift_std):
    drawn = {"n_arms": 3, "mean_loc": 2.5} if given_means is None else {"means": given_means}
    env = GaussianBandit(**drawn, reward_std=0.7, drift_std=drift_std)
    rng, _ = np_random(11)
    env.reset(seed=11)
    for _ in range(2):
        means = given_means or [2.5 + rng.standard_normal() for _ in range(3)]
        assert env.means.tolist() == [means]
        for arm in arms_to_pull(100, 3):
            _, reward, _, _, info = env.step(arm)
            assert reward == means[arm] + 0.7 * rng.standard_normal()
            assert info["expected_reward"] == means[arm]
            assert info["regret"] == max(means) - means[arm]
            if drift_std:
                means = [mean + drift_std * rng.standard_normal() for mean in means]
            assert env.means.tolist() == [means]
        env.reset()


def draw_context(rng, n):
    return [float(np.float32(2.0 * rng.random() - 1.0)) for _ in range(n)]


def weighted_sum(weights, context):
    total = weights[0] * context[0]
    for weight, feature in zip(weights[1:], context[1:], strict=True):
        total += weight * feature
    return total


@pytest.mark.parametrize("redraws", [True, False])
def test_draws_of_linear_bandits(redraws):
    weights = np.random.default_rng(5).standard_normal((4, 9)).tolist()
    arms = {"n_arms": 4, "n_features": 9} if redraws else {"arm_parameters": weights}
    env = LinearBandit(**arms, reward_std=0.5)
    rng, _ = np_random(13)
    shown, _ = env.reset(seed=13)
    for _ in range(2):
        if redraws:
            scale = math.sqrt(3 / 9)
            weights = [[rng.standard_normal() * scale for _ in range(9)] for _ in range(4)]
        assert env.arm_parameters.tolist() == weights
        for arm in arms_to_pull(100, 4):
            context = draw_context(rng, 9)
            assert shown.tolist() == context
            expected = [weighted_sum(row, context) for row in weights]
            shown, reward, _, _, info = env.step(arm)
            assert reward == expected[arm] + 0.5 * rng.standard_normal()
            assert info["expected_reward"] == expected[arm]
            assert info["regret"] == max(expected) - expected[arm]
            assert info["optimal_action"] == expected.index(max(expected))
        draw_context(rng, 9)
        shown, _ = env.reset()


# --- what step tells, and when it ends ------------------------------------------------------------


def test_each_of_several_best_arms_has_no_regret():
    env = BernoulliBandit([0.1, 0.7, 0.7])
    assert env.reset(seed=0)[1] == {}
    for arm, expected, regret in ((0, 0.1, 0.7 - 0.1), (1, 0.7, 0.0), (2, 0.7, 0.0)):
        info = env.step(arm)[4]
        assert (info["optimal_action"], info["expected_reward"]) == (1, expected)
        assert info["regret"] == regret


def test_an_episode_ends_after_its_pulls():
    for kwargs, length in (({}, 1000), ({"max_episode_steps": 40, "pulls": 30}, 40)):
        env = gym.make("GaussianBandit-v0", **kwargs)
        assert time_limit(env) == env.spec.max_episode_steps == length
        env.reset(seed=0)
        assert [env.step(0)[2:4] for _ in range(length)][-2:] == [(False, False), (False, True)]
    assert time_limit(gym.make("GaussianBandit-v0", max_episode_steps=-1)) is None


def test_feedback_is_due_at_the_end_of_each_batch_and_of_the_episode():
    env = gym.make("SegmentBandit-v0", batch_size=5, pulls=12)
    for _ in range(2):
        env.reset(seed=0)
        due = [env.step(0)[4]["feedback_due"] for _ in range(12)]
        assert [i for i in range(12) if due[i]] == [4, 9, 11]


# --- known figures --------------------------------------------------------------------------------


def test_what_a_pooled_test_of_segments_loses_is_exact():
    env = gym.make("SegmentBandit-v0")
    model, horizon = transition_model(env), time_limit(env)
    best = finite_horizon_optimum(model, horizon).start_value / horizon
    random = policy_return(model, np.full((2, 3), 1 / 3), horizon).expected_return / horizon
    assert baseline_return(model, horizon) / horizon == pytest.approx(0.117, abs=1e-12)
    assert best == pytest.approx(0.159, abs=1e-12)
    assert (best - random) * 10_000 == pytest.approx(653.3, abs=0.1)
    env = ScaleReward(gym.make("BernoulliBandit-v0"), 2)  # of coins
    model = transition_model(env)
    assert (model.n_states, model.n_outcomes, model.terminated.any()) == (1, 2, False)
    assert model.expected_reward.tolist() == [[0.4, 1.0, 1.5]]
    assert observations_of_states(env).tolist() == [0]
    assert success_outcomes(env) is None
