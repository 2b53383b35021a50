"""The gap of a policy, split over states; and what estimates of advantages expect."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rl_yardstick.mdp import finite_horizon_optimum, gaps, policy_return
from rl_yardstick.mdp.gaps import discounted_values, expected_estimates
from tests.mdp.test_random_models import deterministic, distributions, models, moved_on


@st.composite
def models_and_policies(draw, n_policies=1):
    """A model, and policies as actions, with time or without, or as probabilities."""
    model, horizon = draw(models()), draw(st.integers(1, 7))
    shape = model.n_states, model.n_actions

    def policy():
        kind = draw(st.sampled_from(["actions", "with time", "probabilities"]))
        if kind == "probabilities":
            return draw(distributions(shape))
        size = (horizon, shape[0]) if kind == "with time" else shape[0]
        return draw(hnp.arrays(np.int64, size, elements=st.integers(0, shape[1] - 1)))

    return model, horizon, *[policy() for _ in range(n_policies)]


def at_each_step(model, policy, horizon):
    """A policy of any form as the chances of actions, shape (horizon, S, A)."""
    chances = np.eye(model.n_actions)[policy] if policy.dtype == np.int64 else policy
    return np.broadcast_to(chances, (horizon, model.n_states, model.n_actions))


@settings(max_examples=40)
@given(models_and_policies())
def test_what_each_state_loses_is_that_of_a_recursion(drawn):
    """The chance to be there at each step, times what is lost by doing what the policy does."""
    model, horizon, policy = drawn
    best, action_values = np.zeros(model.n_states), []
    for _ in range(horizon):
        after = np.where(model.terminated, 0.0, best[model.next_state])
        action_values.append(model.expected_reward + (model.prob * after).sum(axis=2))
        best = action_values[-1].max(axis=1)
    here, losses, visits = model.initial, np.zeros(model.n_states), np.zeros(model.n_states)
    worth = np.zeros((model.n_states, model.n_actions))
    for now, values in zip(at_each_step(model, policy, horizon), action_values[::-1], strict=True):
        losses += here * (values.max(axis=1) - (now * values).sum(axis=1))
        visits, worth = visits + here, worth + here[:, None] * values
        here = moved_on(model, here, now)
    split = gaps.gap_by_state(model, policy, horizon)
    value = policy_return(model, policy, horizon).expected_return
    assert (split.optimum, split.value) == pytest.approx((model.initial @ best, value), abs=1e-9)
    assert split.losses == pytest.approx(losses, abs=1e-9)
    assert (split.losses >= 0).all()
    assert split.visits == pytest.approx(visits, abs=1e-9)
    assert split.action_values * visits[:, None] == pytest.approx(worth, abs=1e-9)


@settings(max_examples=40)
@given(models_and_policies(n_policies=2))
def test_gains_where_two_policies_part_sum_to_their_difference(drawn):
    model, horizon, first, second = drawn
    found = gaps.first_differences(model, first, second, horizon)
    returns = [policy_return(model, one, horizon).expected_return for one in (first, second)]
    assert found.gains.sum() == pytest.approx(returns[0] - returns[1], abs=1e-9)
    assert not gaps.first_differences(model, first, first, horizon).met.any()
    here, met = model.initial, np.zeros(model.n_states)
    for one, two in zip(*(at_each_step(model, p, horizon) for p in (first, second)), strict=True):
        parts = (np.abs(one - two) > 1e-6).any(axis=1)
        met += here * parts
        here = moved_on(model, here * ~parts, one)
    assert found.met == pytest.approx(met, abs=1e-9)


@settings(max_examples=40)
@given(models_and_policies())
def test_repairs_are_the_best_states_to_mend_one_after_the_other(drawn):
    """Against the optimum of a model in which all states but the repaired have one action."""
    model, horizon, policy = drawn
    split = gaps.gap_by_state(model, policy, horizon)
    repairs = gaps.greedy_repairs(model, policy, horizon, split)
    assert len(repairs) <= 3
    if policy.ndim != 1:  # what it does elsewhere has to be fixed
        return
    mask, done = np.eye(model.n_actions, dtype=np.bool_)[policy], policy
    states = np.arange(model.n_states)[:, None]
    for repair in [*repairs, None]:
        losing = gaps.gap_by_state(model, done, horizon).losses > 1e-7
        plans = [
            finite_horizon_optimum(model, horizon, mask=mask | (states == state))
            for state in range(model.n_states)
        ]
        values = np.array([plan.start_value for plan in plans])
        best = max(values[losing], default=split.optimum)
        if repair is None:
            value = repairs[-1].value if repairs else split.value
            assert len(repairs) == 3 or best == pytest.approx(value, abs=1e-8)
            return
        assert repair.value == pytest.approx(best, abs=1e-8)
        assert repair.value == pytest.approx(values[repair.state], abs=1e-8)
        mask, done = mask | (states == repair.state), plans[repair.state].policy.astype(np.int64)


@settings(max_examples=40)
@given(models_and_policies())
def test_the_gradient_of_a_policy_is_that_of_its_return(drawn):
    model, horizon, policy = drawn
    if policy.dtype != np.float64:
        return
    value, slope = gaps.policy_gradient(model, policy, horizon)
    assert value == pytest.approx(policy_return(model, policy, horizon).expected_return, abs=1e-9)
    toward = np.full_like(policy, 1 / model.n_actions) - policy
    step = 1e-6
    nearby = policy_return(model, policy + step * toward, horizon).expected_return
    scale = max(1.0, np.abs(slope).max())
    assert (nearby - value) / step == pytest.approx((slope * toward).sum(), abs=1e-3 * scale)


def test_without_discount_what_may_never_end_has_no_value():
    # Action 0 goes on (rewards 1 and 2, then the end), 1 stays for nothing.
    chain = deterministic([[1, 0], [1, 1]], [[1, 0], [2, 0]], [[False, False], [True, False]])
    # In state 1 it stays for ever; without it, state 0 would have one.
    found = discounted_values(chain, np.array([[0.5, 0.5], [0.0, 1.0]]), 1.0)
    assert np.isnan(found.values).all()
    assert found.action_values[1, 0] == 2.0
    assert np.isnan(found.action_values[[0, 0, 1], [0, 1, 1]]).all()
    ends = discounted_values(chain, np.array([[1.0, 0.0], [0.5, 0.5]]), 1.0)
    assert ends.values == pytest.approx([3.0, 2.0])


def mean_estimates(model, policy, critic, discount, trace, n_left):
    """The mean of the sum of so many TD errors, for each state and action."""
    if n_left == 0:
        return np.zeros_like(policy)
    later = (policy * mean_estimates(model, policy, critic, discount, trace, n_left - 1)).sum(1)
    after = np.where(model.terminated, 0.0, (critic + trace * later)[model.next_state])
    errors = model.reward + discount * after - critic[:, None, None]
    return (model.prob * errors).sum(axis=2)


@settings(max_examples=25)
@given(models(), st.sampled_from([0, 0.5, 0.9]), st.sampled_from([0, 0.6, 1]), st.data())
def test_what_estimates_expect_is_the_mean_over_all_that_may_happen(model, discount, trace, data):
    policy = data.draw(distributions((model.n_states, model.n_actions)))
    critic = data.draw(hnp.arrays(np.float64, model.n_states, elements=st.integers(-9, 9))) / 3
    reachable = np.flatnonzero(model.reachable)
    steps = [(s, a, n) for s in reachable for a in range(model.n_actions) for n in (3, 1, 2)]
    columns = tuple(np.array(steps).T)
    given_action, given_state = expected_estimates(model, policy, critic, discount, trace, columns)
    for i, (state, action, n) in enumerate(steps):
        told = mean_estimates(model, policy, critic, discount, trace, n)[state]
        assert given_action[i] == pytest.approx(told[action], abs=1e-9)
        assert given_state[i] == pytest.approx(policy[state] @ told, abs=1e-9)
