"""Exact evaluation against closed forms and known figures."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from rl_yardstick import mdp
from rl_yardstick.envs.known_models import transition_model
from tests.mdp.test_random_models import deterministic


def model_of(env_id, **kwargs):
    return transition_model(gym.make(f"rl_yardstick.envs:{env_id}", **kwargs))


def coin(end, reward=1.0):
    """One state; each step earns ``reward`` and ends the episode with probability ``end``.

    A second action does the same and never ends it.
    """
    return mdp.TransitionModel(
        prob=np.array([[[end, 1 - end], [1.0, 0.0]]]),
        next_state=np.zeros((1, 2, 2), int),
        reward=np.full((1, 2, 2), reward),
        terminated=np.array([[[True, False], [False, False]]]),
        initial=np.ones(1),
    )


def test_an_episode_without_end():
    found = mdp.policy_return(coin(0.5), np.array([1]), None, 0.9, np.ones((1, 2, 2), bool))
    assert found.expected_return == pytest.approx(10)
    assert found.return_variance == pytest.approx(0)
    assert (found.expected_length, found.success_rate) == (np.inf, 0)
    assert np.isnan(found.length_variance)


@pytest.mark.parametrize("horizon", [None, 400])
def test_drawn_rewards_add_their_own_variance(horizon):
    still = coin(0.2, reward=3)
    drawn = replace(still, reward_variance=np.full((1, 2, 2), 4.0))
    for discount in (1.0, 0.9):
        known = mdp.policy_return(still, np.array([0]), horizon, discount)
        found = mdp.policy_return(drawn, np.array([0]), horizon, discount)
        # Each step is reached with probability 0.8 ** t, and weighs discount ** (2 t).
        added = 4 / (1 - 0.8 * discount**2)
        assert found.return_variance == pytest.approx(known.return_variance + added)
        assert replace(found, return_variance=0.0) == replace(known, return_variance=0.0)


def test_large_chains_are_solved_as_small_ones_are(monkeypatch):
    model = model_of("FrozenLake-v1", map_name="8x8")
    uniform = mdp.baseline_policies(model)[0]
    dense = mdp.policy_return(model, uniform, None, success=model.terminated)
    dense_visits = mdp.state_visitation(model, uniform, None)
    monkeypatch.setattr("rl_yardstick.mdp.graph.LARGEST_DENSE", 0)
    sparse = mdp.policy_return(model, uniform, None, success=model.terminated)
    for name, value in vars(dense).items():
        assert getattr(sparse, name) == pytest.approx(value, rel=1e-10), name
    np.testing.assert_allclose(mdp.state_visitation(model, uniform, None), dense_visits, rtol=1e-10)


def test_forms_of_one_policy_agree():
    model = model_of("FrozenLake-v1")
    actions = mdp.value_iteration(model, 0.99).policy
    matrix = np.eye(4)[actions]
    expected = mdp.policy_return(model, actions, 100)
    for form in (matrix, matrix.astype(np.float32), np.tile(actions.astype(np.uint8), (100, 1))):
        assert mdp.policy_return(model, form, 100) == expected
    # Networks round their probabilities.
    third = np.array([[1 / 3, 2 / 3]])
    rounded = third.astype(np.float32) * np.float32(1 + 1e-6)
    found, exact = (mdp.policy_return(coin(0.5), form, 50) for form in (rounded, third))
    assert found.expected_return == pytest.approx(exact.expected_return)


def test_what_a_policy_says_of_unreachable_states_is_ignored():
    model = model_of("CliffWalking-v1")
    policy = np.where(model.reachable, mdp.value_iteration(model, 1.0).policy, 77)
    assert mdp.policy_return(model, policy, 200).expected_return == -13
    matrix = np.full((model.n_states, 4), 0.25)
    matrix[~model.reachable] = np.nan
    assert np.isfinite(mdp.policy_return(model, matrix, 200).expected_return)


@pytest.mark.parametrize(
    ("policy", "horizon", "message"),
    [
        ([1], None, "from state 0 the policy never ends the episode"),
        ([2], 5, "the policy takes an action outside 0..1"),
        ([[0.5, 0.6]], 5, r"in state 0 the policy's probabilities are \[0.5 0.6\]"),
        ([0], 0, "horizon is 0, it must be at least 1, or None"),
    ],
    ids=str,
)
def test_wrong_policies_are_refused(policy, horizon, message):
    for function in (mdp.policy_return, mdp.state_visitation):
        with pytest.raises(ValueError, match=message):
            function(coin(0.5), np.array(policy), horizon)


@pytest.mark.parametrize(
    ("worth", "advantage", "n_best"), [(5.0, 1e-11, 2), (5.0, 1e-7, 1), (1e7, 1e-5, 2)]
)
def test_actions_are_equal_within_rounding(worth, advantage, n_best):
    model = coin(1.0)
    reward = np.array([[[worth, worth], [worth + advantage] * 2]])
    model = replace(model, reward=reward, terminated=np.ones((1, 2, 2), bool))
    assert mdp.optimal_choices(model, 3)[1].sum() == n_best


def test_a_way_that_goes_round_for_a_million_steps():
    """0 leads to 1, and 1 and 2 to each other, for 1, 2 and 3; seven steps are 1 + 3 (2 + 3)."""
    model = deterministic([[1], [2], [1]], [[1], [2], [3]], [[False]] * 3)
    policy = np.zeros(3, int)
    assert mdp.policy_return(model, policy, 7).expected_return == 16
    assert mdp.policy_return(model, policy, 10**6 + 1).expected_return == 1 + 5 * 10**6 / 2
    assert mdp.policy_return(model, policy, 10**6 + 1).expected_length == 10**6 + 1


def far_goal(end=-50.0, step=-1.0, ends=True):
    """A corridor of ten states: 1 goes on, 0 stays; a step costs, and so may the end."""
    ahead = np.stack([np.arange(10), np.minimum(np.arange(10) + 1, 9)], axis=1)
    last = np.arange(20).reshape(10, 2) == 19
    return deterministic(ahead, np.where(last, end, step), last & ends)


def test_a_limit_that_matters_is_noticed():
    # With an end that costs 50, 30 steps of standing still are better; and 60 are no better than
    # 10 steps to the end, which is too close to call without looking.
    for limit in (30, 58, 62):
        assert mdp.optimum_far_from_limit(far_goal(), limit) is None
    assert mdp.optimum_far_from_limit(far_goal(), 200) == -59.0
    assert mdp.finite_horizon_optimum(far_goal(), 30).start_value == -30.0
    # Where steps cost nothing, or nobody arrives, nothing can be said.
    assert mdp.optimum_far_from_limit(far_goal(end=5.0, step=0.0), 10**6) is None
    assert mdp.optimum_far_from_limit(far_goal(ends=False), 10**6) is None
