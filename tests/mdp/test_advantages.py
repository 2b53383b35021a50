"""Values under a discount, and what advantage estimation expects, by hand and by enumeration."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mdp.advantages import discounted_values, expected_estimates
from tests.mdp.test_random_models import deterministic, distributions, models


def chain():
    """Two states: 0 goes on (rewards 1 and 2, then the end), 1 stays for nothing."""
    return deterministic([[1, 0], [1, 1]], [[1, 0], [2, 0]], [[False, False], [True, False]])


EVEN = np.full((2, 2), 0.5)


def test_values_of_a_chain_worked_out_by_hand():
    # V(1) = 1/2 2 + 1/2 1/2 V(1), and V(0) = 1/2 (1 + 1/2 V(1)) + 1/2 1/2 V(0).
    found = discounted_values(chain(), EVEN, 0.5)
    assert found.values == pytest.approx([10 / 9, 4 / 3])
    assert found.action_values == pytest.approx(np.array([[5 / 3, 5 / 9], [2, 2 / 3]]))
    assert found.advantages == pytest.approx(np.array([[5 / 9, -5 / 9], [2 / 3, -2 / 3]]))


def test_without_discount_what_may_never_end_has_no_value():
    # In state 1 it stays for ever; without it, state 0 would have one.
    found = discounted_values(chain(), np.array([[0.5, 0.5], [0.0, 1.0]]), 1.0)
    assert np.isnan(found.values).all()
    assert found.action_values[1, 0] == 2.0
    assert np.isnan(found.action_values[[0, 0, 1], [0, 1, 1]]).all()
    ends = discounted_values(chain(), np.array([[1.0, 0.0], [0.5, 0.5]]), 1.0)
    assert ends.values == pytest.approx([3.0, 2.0])


@st.composite
def drawn_cases(draw):
    model = draw(models())
    policy = draw(distributions((model.n_states, model.n_actions)))
    numbers = st.floats(-3, 3, width=16)
    critic = np.array(draw(st.lists(numbers, min_size=model.n_states, max_size=model.n_states)))
    return model, policy, critic, draw(st.sampled_from([0.0, 0.5, 0.9]))


def by_enumeration(model, policy, critic, discount, trace, state, action, n_left):
    """The mean of the sum of TD errors, over all that may happen in so many steps."""
    if n_left == 0:
        return 0.0
    total = 0.0
    for k in range(model.n_outcomes):
        chance, after = model.prob[state, action, k], model.next_state[state, action, k]
        if chance == 0:
            continue
        goes_on = not model.terminated[state, action, k]
        error = model.reward[state, action, k] - critic[state]
        if goes_on:
            error += discount * critic[after]
            for then in range(model.n_actions):
                later = by_enumeration(
                    model, policy, critic, discount, trace, after, then, n_left - 1
                )
                error += discount * trace * policy[after, then] * later
        total += chance * error
    return total


@settings(max_examples=25)
@given(drawn_cases(), st.sampled_from([0.0, 0.6, 1.0]))
def test_what_estimates_expect_is_the_mean_over_all_that_may_happen(case, trace):
    model, policy, critic, discount = case
    reachable = np.flatnonzero(model.reachable)
    steps = [(s, a, n) for s in reachable for a in range(model.n_actions) for n in (3, 1, 2)]
    columns = tuple(np.array(steps).T)
    given_action, given_state = expected_estimates(model, policy, critic, discount, trace, columns)
    for i, (state, action, n) in enumerate(steps):
        told = [
            by_enumeration(model, policy, critic, discount, trace, state, a, n)
            for a in range(model.n_actions)
        ]
        assert given_action[i] == pytest.approx(told[action], abs=1e-9)
        assert given_state[i] == pytest.approx(policy[state] @ told, abs=1e-9)
