"""The rules of the bandit agents, on updates that were worked by hand and on closed forms."""

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.bandits import rules
from rl_yardstick.agents.bandits.algorithm import Pull
from rl_yardstick.agents.bandits.runs import run_batch, run_one_by_one
from rl_yardstick.agents.compiled.worlds import NotCompilable
from tests.agents.hand_fed import Spaces

ARMS = 3


def agent(name, observations=1, **kwargs):
    return load_algorithm(name)(env=Spaces(observations, ARMS), seed=0, **kwargs)


def taught(name, pulls, **kwargs):
    """An agent that has learnt from pairs of arm and reward."""
    model = agent(name, **kwargs)
    for arm, reward in pulls:
        model._learn(Pull(0, arm, reward, 1.0))
    return model


def scores(model):
    return model.policy.scores.numpy()[0]


def choices(model, n=2000):
    """Arms that the exploring agent chooses, what it knows staying as it is."""
    return model._choose(np.zeros(n, dtype=np.int64), np.random.default_rng(0))[0]


def shares(model, n=20_000):
    return np.bincount(choices(model, n), minlength=ARMS) / n


def test_sample_averages():
    model = taught("epsilon_greedy", [(0, 1.0), (0, 4.0), (2, -2.0), (0, 1.0)])
    assert scores(model).tolist() == [2.0, 0.0, -2.0]
    assert model.policy.counts.tolist() == [[3, 0, 1]]
    assert model.policy.sums.tolist() == [[6.0, 0.0, -2.0]]
    # A constant step from an optimistic start.
    model = taught("epsilon_greedy", [(1, 1.0), (1, 3.0)], learning_rate=0.5, initial_q=5.0)
    assert scores(model).tolist() == [5.0, 3.0, 5.0]


SHARES = [
    ("epsilon_greedy", [(1, 1)], {"exploration_initial_eps": 0.3}, [0.1, 0.8, 0.1]),
    # By the softmax of 1, 3 and 2.
    ("boltzmann", [(0, 0.1), (1, 0.3), (2, 0.2)], {"temperature": 0.1},
     np.exp([1, 3, 2]) / np.exp([1, 3, 2]).sum()),
]  # fmt: skip


@pytest.mark.parametrize(("name", "pulls", "settings", "expected"), SHARES)
def test_how_often_each_arm_is_pulled(name, pulls, settings, expected):
    """Of 20,000 draws four standard errors are at most .014."""
    assert shares(taught(name, pulls, **settings)) == pytest.approx(expected, abs=0.014)


L6, L7 = math.log(6), math.log(7)
INDICES = [  # after 6 pulls: UCB1 takes 2 ln 6, Sutton and Barto the logarithm of the seventh
    ({}, 2 * L6, 1.0),
    ({"c": 0.1}, 2 * L6, 0.1),
    ({"variant": "sutton_barto"}, L7, 2.0),
    ({"variant": "sutton_barto", "c": 1.0}, L7, 1.0),
]


@pytest.mark.parametrize(("kwargs", "logarithm", "width"), INDICES)
def test_ucb_index(kwargs, logarithm, width):
    model = agent("ucb", **kwargs)
    for mean, count in ((0.5, 4), (1.0, 1)):
        index = rules.ucb_index(model.compiled_agent(model.rng), mean, count, 6)
        assert index == pytest.approx(mean + width * math.sqrt(logarithm / count), rel=1e-15)


@pytest.mark.parametrize("name", ["ucb", "kl_ucb"])
def test_arms_not_tried_come_first(name):
    model = taught(name, [(1, 1.0)], tie_breaking="first")
    assert set(choices(model, 5)) == {0}
    assert set(choices(taught(name, [(1, 1.0)]))) == {0, 2}
    assert set(choices(taught(name, [(0, 1.0), (2, 1.0)], tie_breaking="first"), 5)) == {1}
    # What is recommended has been seen to be good, however bad that is.
    assert model.predict(0, deterministic=True)[0] == 1


def kl_ucb_index(mean, count, pulls, c=0.0):
    model = agent("kl_ucb", c=c)
    return rules.kl_ucb_index(model.compiled_agent(model.rng), mean, count, pulls)


@given(st.floats(0.0, 0.999), st.integers(1, 10_000), st.integers(2, 10**6))
def test_kl_ucb_index_solves_its_equation(mean, count, pulls):
    index = kl_ucb_index(mean, count, pulls)
    assert mean <= index < 1.0
    budget = math.log(pulls) / count
    if index < 1 - 1e-9:
        assert rules.bernoulli_kl(mean, index) == pytest.approx(budget, rel=1e-5, abs=1e-9)
    else:
        # So near to 1, the next number on is already too high, or is 1.
        assert rules.bernoulli_kl(mean, 1 - 1e-9) <= budget


def test_kl_ucb_where_it_has_a_closed_form():
    for budget in (1e-6, 0.1, 1.0, 5.0):
        assert rules.kl_upper_bound(0.0, budget) == pytest.approx(1 - math.exp(-budget), rel=1e-12)
        assert rules.kl_upper_bound(1.0, budget) == 1.0
    assert rules.kl_upper_bound(0.3, 0.0) == 0.3
    with_c = kl_ucb_index(0.3, 10, 100, c=3.0)
    budget = (math.log(100) + 3 * math.log(math.log(100))) / 10
    assert with_c == pytest.approx(rules.kl_upper_bound(0.3, budget), rel=1e-15)


def test_gradient_step_by_hand():
    """The first reward is its own baseline and moves nothing; the second is 2 above it."""
    model = taught("gradient_bandit", [(0, 1.0)], learning_rate=0.3)
    assert scores(model).tolist() == [0.0, 0.0, 0.0]
    model._learn(Pull(0, 1, 3.0, 1.0))
    assert scores(model) == pytest.approx([-0.2, 0.4, -0.2], rel=1e-15)
    # The baseline is now the mean of 1 and 3, before the reward 5 is counted in; without it all of
    # the reward counts. The direction is that of automatic differentiation.
    for baseline, advantage in ((True, 5.0 - 2.0), (False, 5.0)):
        pulls = [(0, 1.0), (1, 3.0)]
        model = taught("gradient_bandit", pulls, learning_rate=0.3, baseline=baseline)
        preferences = th.tensor(scores(model), requires_grad=True)
        th.log_softmax(preferences, 0)[2].backward()
        expected = scores(model) + 0.3 * advantage * preferences.grad.numpy()
        model._learn(Pull(0, 2, 5.0, 1.0))
        assert scores(model) == pytest.approx(expected, rel=1e-12)


def test_exp3_weighs_a_reward_by_how_unlikely_it_was():
    model = agent("exp3", mixing=0.3)
    assert model._choose(np.zeros(1, np.int64), model.rng)[1] == pytest.approx([1 / 3], rel=1e-15)
    model._learn(Pull(0, 1, 0.5, 0.25))
    # exp(gamma / K * reward / probability), as a logarithm.
    assert scores(model).tolist() == pytest.approx([0.0, 0.3 / 3 * 0.5 / 0.25, 0.0], rel=1e-15)
    weights = np.exp(scores(model))
    expected = 0.7 * weights / weights.sum() + 0.1
    assert shares(model) == pytest.approx(expected, abs=0.01)
    arms, probabilities = model._choose(np.zeros(20, np.int64), model.rng)
    assert probabilities == pytest.approx(expected[arms], rel=1e-12)


def test_thompson_beta_posterior():
    model = taught("thompson", [(0, 1.0), (0, 1.0), (0, 0.0), (2, 0.0)])
    assert model.posterior(model.policy.tables)[0].tolist() == [[3, 2], [1, 1], [1, 2]]
    assert scores(model).tolist() == pytest.approx([3 / 5, 1 / 2, 1 / 3], rel=1e-15)
    # How often each of three Beta draws is the highest, from a sample of NumPy's.
    draws = np.random.default_rng(5).beta([3, 1, 1], [2, 1, 2], size=(200_000, 3))
    expected = np.bincount(draws.argmax(axis=1)) / 200_000
    assert shares(model) == pytest.approx(expected, abs=0.015)


def test_thompson_gaussian_posterior():
    prior = {"likelihood": "gaussian", "prior_mean": 1.0, "prior_std": 2.0, "reward_std": 0.5}
    model = taught("thompson", [(0, 3.0), (0, 5.0)], **prior)
    precision = 1 / 4 + 2 / 0.25
    mean = (1 / 4 * 1.0 + (3.0 + 5.0) / 0.25) / precision
    assert model.posterior(model.policy.tables)[0, 0] == pytest.approx([mean, precision**-0.5])
    assert model.posterior(model.policy.tables)[0, 1].tolist() == [1.0, 2.0]
    assert scores(model) == pytest.approx([mean, 1.0, 1.0], rel=1e-15)


CONTEXT_SPACE = spaces.Box(-1, 1, (4,))


def ridge_regressions(pulls, ridge):
    """What each arm's regression comes to, by NumPy's solver."""
    matrices = [ridge * np.eye(4) for _ in range(ARMS)]
    moments = np.zeros((ARMS, 4))
    for arm, context, reward in pulls:
        matrices[arm] += np.outer(context, context)
        moments[arm] += reward * context
    return matrices, moments


def linear_pulls(n=200):
    rng = np.random.default_rng(2)
    arms = rng.integers(0, ARMS - 1, n)  # the last arm is never pulled
    return list(zip(arms.tolist(), rng.uniform(-1, 1, (n, 4)), rng.normal(size=n), strict=True))


def test_linear_models_are_ridge_regressions():
    ridge = 0.01
    model = agent("linucb", CONTEXT_SPACE, alpha=0.7, ridge=ridge, tie_breaking="first")
    pulls = linear_pulls()
    for arm, context, reward in pulls:
        model._learn(Pull(context.tolist(), arm, reward, 1.0))
    matrices, moments = ridge_regressions(pulls, ridge)
    solutions = np.array([np.linalg.solve(a, b) for a, b in zip(matrices, moments, strict=True)])
    assert model.policy.coefficients.numpy() == pytest.approx(solutions, rel=1e-10)
    for arm, factors in enumerate(model.policy.factors.numpy()):
        lower = np.tril(factors, -1) + np.eye(4)
        assert lower @ np.diag(np.diag(factors)) @ lower.T == pytest.approx(matrices[arm])
    for context in np.random.default_rng(3).uniform(-1, 1, (50, 4)):
        bounds = [
            context @ solution + 0.7 * math.sqrt(context @ np.linalg.inv(a) @ context)
            for solution, a in zip(solutions, matrices, strict=True)
        ]
        chosen, _ = model._choose(context[None], model.rng)
        assert chosen[0] == np.argmax(bounds)
        best = model.predict(context, deterministic=True)[0]
        assert best == np.argmax(context.astype(np.float32) @ solutions.T)


def test_linear_thompson_samples_from_the_posterior():
    """A draw of all coefficients and one of the mean reward choose alike."""
    model, pulls, n = agent("lin_thompson", CONTEXT_SPACE, alpha=0.5), linear_pulls(40), 40_000
    for arm, context, reward in pulls:
        model._learn(Pull(context.tolist(), arm, reward, 1.0))
    context, rng, sampled = np.array([0.2, -0.4, 0.1, 0.9]), np.random.default_rng(4), []
    for a, b in zip(*ridge_regressions(pulls, 1.0), strict=True):
        posterior = np.linalg.solve(a, b), 0.25 * np.linalg.inv(a)
        sampled.append(rng.multivariate_normal(*posterior, n) @ context)
    expected = np.bincount(np.argmax(sampled, axis=0), minlength=ARMS) / n
    chosen, _ = model._choose(np.tile(context, (n, 1)), np.random.default_rng(0))
    assert np.bincount(chosen, minlength=ARMS) / n == pytest.approx(expected, abs=0.012)
    assert expected.min() > 0.02


def test_one_hot_contexts_are_averages_with_a_ridge():
    model = agent("linucb", 2)
    for row, arm, reward in ((0, 1, 1.0), (0, 1, 1.0), (1, 2, 4.0)):
        model._learn(Pull(model._contexts(np.array([row]))[0].tolist(), arm, reward, 1.0))
    assert model.policy.coefficients.tolist() == [[0, 0], [2 / 3, 0], [0, 2]]
    assert model.predict(np.array([0, 1]), deterministic=True)[0].tolist() == [1, 2]


COINS, NORMAL, SEGMENTS = "BernoulliBandit-v0", "GaussianBandit-v0", "SegmentBandit-v0"
LOG = Path(__file__).parents[1] / "envs" / "uniform_log.csv"


@pytest.mark.parametrize(
    ("env_id", "kwargs", "numbers"),
    [
        # At the end of the episode, what is there comes in.
        (SEGMENTS, {"batch_size": 3, "max_episode_steps": 7}, [0, 0, 3, 3, 3, 6, 7]),
        (COINS, {}, [1, 2, 3, 4]),
        # What the log does not tell of is passed over.
        ("ReplayBandit-v0", {"log": str(LOG)}, [1, 1, 2, 3, 4, 5, 6]),
    ],
)
def test_what_is_learnt_after_each_pull(env_id, kwargs, numbers):
    env, found = make_vec_env(env_id, seed=0, env_kwargs=kwargs), []
    model = load_algorithm("ucb")(env=env, seed=0, tie_breaking="first")
    for _ in numbers:
        model.learn(1, reset_num_timesteps=False)
        found.append(int(model.policy.counts.sum()))
    assert found == numbers
    assert model._n_updates == numbers[-1]
    assert model.num_timesteps == len(numbers)


def test_rewards_that_do_not_fit():
    shifted = gym.wrappers.TransformReward(gym.make(COINS), lambda reward: reward + 0.5)
    for env, line in (
        (shifted, "Thompson as it is set learns from rewards that are 0 or 1, not"),
        (NORMAL, "this environment's have normal noise"),
    ):
        with pytest.raises(ValueError, match=line):
            load_algorithm("thompson")(env=env, seed=0).learn(1)


COIN, VECTORS = (COINS, {}), ("LinearBandit-v0", {})
SEGMENTED = SEGMENTS, {"batch_size": 7, "pulls": 240}
DRIFTING = NORMAL, {"drift_std": 0.1, "n_arms": 4, "means": [0, 0, 0, 0]}
FALLING = {"exploration_decay": "exponential", "exploration_initial_eps": 0.9}
FALLING |= {"learning_rate": 0.1, "initial_q": 2.0, "tie_breaking": "first"}
CASES = [
    ("epsilon_greedy", FALLING, *DRIFTING),
    ("boltzmann", {"temperature": 0.2}, *SEGMENTED),
    ("ucb", {"variant": "sutton_barto", "tie_breaking": "first"}, *SEGMENTED),
    ("kl_ucb", {}, *COIN),
    ("gradient_bandit", {"baseline": False, "ignore_context": True}, *SEGMENTED),
    ("exp3", {}, *SEGMENTED),
    ("thompson", {}, *SEGMENTED),
    ("linucb", {}, *VECTORS),
    ("lin_thompson", {"alpha": 0.3, "tie_breaking": "first"}, *VECTORS),
    ("lin_epsilon_greedy", {"exploration_decay": "linear"}, *COIN),
]
ARRAYS = ("seeds", "arms", "rewards", "regrets", "contexts", "estimates", "coefficients")


@pytest.mark.parametrize(("name", "kwargs", "env_id", "env_kwargs"), CASES)
def test_a_batch_is_its_runs_one_by_one(name, kwargs, env_id, env_kwargs):
    batch = run_batch(name, kwargs, env_id, env_kwargs, [0, 7], 150)
    single = run_one_by_one(name, kwargs, env_id, env_kwargs, [0, 7], 150)
    for array in ARRAYS:
        ours, theirs = getattr(batch, array), getattr(single, array)
        assert (ours is None) == (theirs is None), array
        if ours is not None:
            assert ours.dtype == theirs.dtype
            assert np.array_equal(ours, theirs, equal_nan=ours.dtype.kind == "f"), array
    assert len(set(batch.arms[0].tolist())) > 1


def test_posteriors_at_some_moments():
    result = run_batch("thompson", {}, COINS, {}, range(3), moments=(100, 10, 5000))
    assert result.moments == (10, 100, 1000)
    assert result.posteriors.shape == (3, 3, 1, 3, 2)
    for index, moment in enumerate(result.moments):
        for run in range(3):
            arms, rewards = result.arms[run, :moment], result.rewards[run, :moment]
            wins, pulls = np.bincount(arms, rewards, minlength=3), np.bincount(arms, minlength=3)
            expected = np.stack([1 + wins, 1 + pulls - wins], axis=1)
            assert result.posteriors[run, index, 0].tolist() == expected.tolist()
    assert run_batch("thompson", {}, COINS, {}, [0], moments=()).moments == (1000,)
    assert run_batch("ucb", {}, COINS, {}, [0]).posteriors is None


@pytest.mark.parametrize(
    ("name", "env_id", "pulls", "line"),
    [
        ("ucb", "FrozenLake-v1", None, "there is no compiled copy of FrozenLakeEnv"),
        ("ucb", COINS, 1001, "pulls must lie between 1 and 1000, an episode, not 1001"),
    ],
)
def test_what_cannot_be_compiled_is_refused(name, env_id, pulls, line):
    with pytest.raises((NotCompilable, ValueError), match=line):
        run_batch(name, {}, env_id, {}, [0], pulls)


@pytest.mark.parametrize(
    ("ours", "theirs", "env_id", "kwargs"),
    [
        ("ucb", "mabwiser_ucb1", NORMAL, {"c": 0.5}),
        ("linucb", "mabwiser_linucb", "LinearBandit-v0", {}),
    ],
)
def test_ours_and_theirs_pull_the_same_arms(ours, theirs, env_id, kwargs):
    """The update is the same to the last digit that a decision can hang on."""
    args = env_id, {"pulls": 300}, [0]
    first = run_batch(ours, {**kwargs, "tie_breaking": "first"}, *args)
    second = run_one_by_one(theirs, kwargs, *args)
    assert np.array_equal(first.arms, second.arms)
    assert np.array_equal(first.rewards, second.rewards)
    assert len(set(first.arms[0].tolist())) > 2
