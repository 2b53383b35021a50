"""The gap of a policy, split over states: exact sums, repairs by brute force, sampled episodes."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.known_models import transition_model
from mdp import finite_horizon_optimum, policy_return
from mdp.gaps import (
    TooLargeError,
    first_differences,
    gap_by_state,
    greedy_repairs,
    policy_gradient,
)
from tests.mdp.test_random_models import distributions, models


@st.composite
def models_and_policies(draw, n_policies=1):
    """A model, and policies as actions, with time or without, or as probabilities."""
    model, horizon = draw(models()), draw(st.integers(1, 7))
    shape = model.n_states, model.n_actions

    def policy():
        kind = draw(st.sampled_from(["actions", "with time", "probabilities"]))
        if kind == "probabilities":
            return draw(distributions(shape))
        n_steps = horizon if kind == "with time" else 1
        rows = [
            draw(st.lists(st.integers(0, shape[1] - 1), min_size=shape[0], max_size=shape[0]))
            for _ in range(n_steps)
        ]
        return np.array(rows) if kind == "with time" else np.array(rows[0])

    return model, horizon, *[policy() for _ in range(n_policies)]


@given(models_and_policies())
def test_what_states_lose_sums_to_the_gap(drawn):
    model, horizon, policy = drawn
    split = gap_by_state(model, policy, horizon)
    optimum = finite_horizon_optimum(model, horizon).start_value
    value = policy_return(model, policy, horizon).expected_return
    assert (split.optimum, split.value) == pytest.approx((optimum, value), abs=1e-9)
    assert (split.losses >= 0).all()
    assert split.losses.sum() == pytest.approx(optimum - value, abs=1e-9)


@given(models_and_policies(n_policies=2))
def test_gains_where_two_policies_part_sum_to_their_difference(drawn):
    model, horizon, first, second = drawn
    found = first_differences(model, first, second, horizon)
    returns = [policy_return(model, one, horizon).expected_return for one in (first, second)]
    assert found.gains.sum() == pytest.approx(returns[0] - returns[1], abs=1e-9)
    assert 0 <= found.met.sum() <= 1 + 1e-9
    assert not first_differences(model, first, first, horizon).met.any()


@given(models_and_policies())
def test_a_repair_is_the_best_single_state_to_mend(drawn):
    """Against each state's own optimum: a model in which all other states have one action."""
    model, horizon, policy = drawn
    split = gap_by_state(model, policy, horizon)
    repairs = greedy_repairs(model, policy, horizon, split, most=1)
    if policy.ndim != 1:  # what it does elsewhere has to be fixed
        return
    fixed = np.eye(model.n_actions, dtype=np.bool_)[policy]
    values = [
        finite_horizon_optimum(
            model, horizon, mask=fixed | (np.arange(model.n_states) == state)[:, None]
        ).start_value
        for state in range(model.n_states)
    ]
    best = max([split.value, *values])
    assert (repairs[0].value if repairs else split.value) == pytest.approx(best, abs=1e-8)


@given(models_and_policies())
def test_the_gradient_of_a_policy_is_that_of_its_return(drawn):
    model, horizon, policy = drawn
    if policy.dtype != np.float64:
        return
    value, slope = policy_gradient(model, policy, horizon)
    assert value == pytest.approx(policy_return(model, policy, horizon).expected_return, abs=1e-9)
    toward = np.full_like(policy, 1 / model.n_actions) - policy
    step = 1e-6
    nearby = policy_return(model, policy + step * toward, horizon).expected_return
    scale = max(1.0, np.abs(slope).max())
    assert (nearby - value) / step == pytest.approx((slope * toward).sum(), abs=1e-3 * scale)


def test_splitting_agrees_with_ten_thousand_episodes():
    """Each state's loss is what episodes lose there, within four standard errors."""
    model = transition_model(gym.make("FrozenLake-v1"))
    horizon, n_episodes, rng = 30, 10_000, np.random.default_rng(0)
    policy = rng.integers(model.n_actions, size=model.n_states)
    split = gap_by_state(model, policy, horizon)
    best = [np.zeros(model.n_states)]
    for _ in range(horizon):
        after = np.where(model.terminated, 0.0, best[-1][model.next_state])
        values = model.expected_reward + (model.prob * after).sum(axis=2)
        best.append(values.max(axis=1))
    lost = np.zeros((n_episodes, model.n_states))
    state = rng.choice(model.n_states, n_episodes, p=model.initial)
    running = np.ones(n_episodes, bool)
    for left in range(horizon, 0, -1):
        after = np.where(model.terminated, 0.0, best[left - 1][model.next_state])
        values = model.expected_reward + (model.prob * after).sum(axis=2)
        cost = best[left][state] - values[state, policy[state]]
        lost[np.flatnonzero(running), state[running]] += cost[running]
        shares = model.prob[state, policy[state]].cumsum(axis=1)
        outcome = (rng.random(n_episodes)[:, None] > shares).sum(axis=1)
        at = state, policy[state], np.minimum(outcome, model.n_outcomes - 1)
        running &= ~model.terminated[at]
        state = model.next_state[at]
    error = lost.std(axis=0) / np.sqrt(n_episodes)
    assert (np.abs(lost.mean(axis=0) - split.losses) <= 4 * error + 1e-9).all()
    assert (split.losses > 0).sum() > 5


def test_worlds_that_are_too_large_are_refused():
    model = transition_model(gym.make("envs:RandomWarehouse-v0", size=100).unwrapped)
    with pytest.raises(TooLargeError, match="too many to keep"):
        first_differences(model, np.zeros(model.n_states, int), np.zeros(model.n_states, int), 9999)
