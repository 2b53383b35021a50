"""What other rewards make of the optimal policies: by hand, by brute force, and potentials."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rl_yardstick.mdp import policy_return
from rl_yardstick.mdp.shaping import discounted_effect, effect_under_limit
from tests.mdp.test_random_models import deterministic, every_policy, models

DISCOUNTS = [0.3, 0.9]


def worth(*args):
    return policy_return(*args).expected_return


def crossing(stop=1.0):
    """In state 0: stop for a reward, or go on to state 1 for nothing, where the end earns 3."""
    return deterministic([[0, 1], [1, 1]], [[stop, 0], [3, 3]], [[True, False], [True, True]])


@pytest.mark.parametrize(
    ("bonus", "same", "discounted", "judged", "factor"),
    [
        # To go on is worth 0.5 * 3; to stop is worse by 0.25 instead of 0.5: half as much.
        (0.25, True, (1.5, 1.5), (3.0, 3.0), 0.5),
        (0.5, False, (1.5, 1.0), (3.0, 1.0), None),  # a tie: either may be done
        (1.0, False, (1.0, 1.0), (1.0, 1.0), None),
    ],
)
def test_a_bonus_for_stopping_by_hand(bonus, same, discounted, judged, factor):
    found = discounted_effect(crossing(), crossing(1.0 + bonus), 0.5, 10)
    assert (found.is_same, found.optimum) == (same, 1.5)
    assert (found.returns, found.judged) == (discounted, judged)
    assert found.judged_before == (3.0, 3.0)
    assert found.differs.tolist() == [not same, False]
    assert found.factor == factor
    # Without a discount, to go on earns 3, and no such bonus changes that.
    later = effect_under_limit(crossing(), crossing(1.0 + bonus), 10)
    assert (later.is_same, later.optimum, later.returns) == (True, 3.0, (3.0, 3.0))


def shaped_by(model, potential, discount, factor=1.0):
    """The model with rewards times a factor, plus the difference of a potential."""
    after = np.where(model.terminated, 0.0, potential[model.next_state])
    shaped = factor * model.reward + discount * after - potential[:, None, None]
    return replace(model, reward=shaped)


def potentials(model):
    return hnp.arrays(np.int64, model.n_states, elements=st.integers(-9, 9))


@settings(max_examples=40)
@given(st.data(), models(), st.sampled_from(DISCOUNTS), st.sampled_from([0.01, 1.0, 7.0]))
def test_a_potential_costs_nothing_and_is_found(data, model, discount, factor):
    potential = data.draw(potentials(model)).astype(np.float64)
    found = discounted_effect(model, shaped_by(model, potential, discount, factor), discount, 5)
    assert found.is_same
    assert (found.optimal == found.shaped).all()
    assert found.returns == pytest.approx((found.optimum,) * 2, abs=1e-9)
    assert found.judged == pytest.approx(found.judged_before, abs=1e-9)
    assert found.factor is not None
    rest = shaped_by(model, found.potential, discount, found.factor).expected_reward
    wanted = shaped_by(model, potential, discount, factor).expected_reward
    assert rest[model.reachable] == pytest.approx(wanted[model.reachable], abs=1e-7)


def assert_effect(found, returns, ours, theirs):
    """Of the returns of all policies, and which of them are optimal before and after."""
    assert found.optimum == pytest.approx(returns.max(), abs=1e-9)
    ends = returns[theirs].max(), returns[theirs].min()
    assert found.returns == pytest.approx(ends, abs=1e-9)
    assert found.is_same == (ours == theirs).all()


@settings(max_examples=30)
@given(st.data(), models(states=3, actions=2), st.sampled_from(DISCOUNTS))
def test_best_and_worst_are_those_of_all_optimal_policies(data, model, discount):
    rewards = hnp.arrays(np.int64, model.prob.shape, elements=st.integers(-3, 3))
    shaped = replace(model, reward=data.draw(rewards))
    found = discounted_effect(model, shaped, discount, 4)
    policies = every_policy(model)
    starts = [replace(model, initial=row) for row in np.eye(model.n_states)[model.reachable]]

    def are_optimal(reward):
        """By policy, whether no other is better from any state."""
        each = [replace(start, reward=reward) for start in starts]
        values = [[worth(one, policy, None, discount) for one in each] for policy in policies]
        return (np.array(values) >= np.max(values, axis=0) - 1e-9).all(axis=1)

    returns = np.array([worth(model, p, None, discount) for p in policies])
    assert_effect(found, returns, are_optimal(model.reward), are_optimal(shaped.reward))
    assert worth(model, found.worst_policy, 4) == pytest.approx(found.judged[1], abs=1e-9)


@settings(max_examples=30)
@given(st.data(), models(states=2, actions=2), st.integers(1, 3))
def test_best_and_worst_under_a_limit_are_those_of_all_optimal_policies(data, model, horizon):
    rewards = hnp.arrays(np.int64, model.prob.shape, elements=st.integers(-3, 3))
    shaped = replace(model, reward=data.draw(rewards))
    found = effect_under_limit(model, shaped, horizon)
    policies = every_policy(model, horizon)
    both = [[worth(each, p, horizon) for p in policies] for each in (model, shaped)]
    returns, others = np.array(both)
    ours, theirs = returns >= returns.max() - 1e-9, others >= others.max() - 1e-9
    assert_effect(found, returns, ours, theirs)
    for policy, value in ((found.policy, found.optimum), (found.worst_policy, found.returns[1])):
        assert worth(model, policy, horizon) == pytest.approx(value, abs=1e-9)


def test_where_training_never_comes_every_action_may_be_taken():
    # Training begins in state 1, so nothing is learnt about state 0.
    training = replace(crossing(), initial=np.array([0.0, 1.0]))
    found = discounted_effect(crossing(), training, 0.5, 10)
    assert (found.differs.tolist(), found.returns) == ([True, False], (1.5, 1.0))


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ValueError, match=r"discount is 1\.0"):
        discounted_effect(crossing(), crossing(), 1.0, 10)
    with pytest.raises(ValueError, match="too many to plan"):
        discounted_effect(crossing(), crossing(), 0.5, 10**9)
    other = deterministic([[0, 0]], [[0, 0]], [[True, True]])
    with pytest.raises(ValueError, match="1 states and 2 actions cannot be compared with 2 states"):
        effect_under_limit(crossing(), other, 3)
