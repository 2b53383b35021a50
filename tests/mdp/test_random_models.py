"""Planning and evaluation on random models, against Bellman's equation and brute force."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rl_yardstick import mdp


@st.composite
def distributions(draw, shape):
    """Small fractions along the last axis, zeros among them."""
    weight = draw(hnp.arrays(np.int64, shape, elements=st.integers(0, 3)))
    weight[..., 0] += weight.sum(axis=-1) == 0
    return weight / weight.sum(axis=-1, keepdims=True)


@st.composite
def models(draw, states=5, actions=3, outcomes=3, always_ends=False):
    """Models of up to the given sizes, with small whole numbers as rewards.

    With ``always_ends``, the first outcome of each state and action ends the episode.
    """
    n_states, n_actions = draw(st.integers(1, states)), draw(st.integers(1, actions))
    shape = (n_states, n_actions, draw(st.integers(1, outcomes)))
    prob = draw(distributions(shape))
    terminated = draw(hnp.arrays(np.bool_, shape))
    if always_ends:
        prob = 0.75 * prob + 0.25 * (np.arange(shape[2]) == 0)
        terminated[..., 0] = True
    return mdp.TransitionModel(
        prob=prob,
        next_state=draw(hnp.arrays(np.int64, shape, elements=st.integers(0, n_states - 1))),
        reward=draw(hnp.arrays(np.int64, shape, elements=st.integers(-3, 3))),
        terminated=terminated,
        initial=draw(distributions((n_states,))),
    )


def deterministic(next_state, reward, terminated):
    """A model without chance that begins in state 0, from tables of shape (S, A)."""
    following = np.array(next_state)[..., None]
    return mdp.TransitionModel(
        prob=np.ones(following.shape),
        next_state=following,
        reward=np.array(reward, np.float64)[..., None],
        terminated=np.array(terminated, np.bool_)[..., None],
        initial=np.eye(len(following))[0],
    )


def moved_on(model, here, chances):
    """The chance to be in each state one step later, by those now and those of the actions."""
    going_on = (here[:, None] * chances)[..., None] * model.prob * ~model.terminated
    return np.bincount(model.next_state.ravel(), going_on.ravel(), model.n_states)


@given(models(), st.sampled_from([0.0, 0.3, 0.9, 0.99]))
def test_discounted_values_of_both_planners_solve_the_equation_of_the_optimum(model, discount):
    one, two = mdp.value_iteration(model, discount), mdp.policy_iteration(model, discount)
    # The tolerance, or with values up to 300 over 1 - 0.99 what rounding leaves.
    assert one.error_bound <= 2e-10
    bound = one.error_bound + two.error_bound
    np.testing.assert_allclose(one.values, two.values, rtol=0, atol=bound)
    after = np.where(model.terminated, 0.0, one.values[model.next_state])
    best = (model.expected_reward + discount * (model.prob * after).sum(axis=2)).max(axis=1)
    np.testing.assert_allclose(one.values[model.reachable], best[model.reachable], atol=1e-9)
    assert one.start_value == pytest.approx(model.initial @ two.values, abs=1e-9)


def every_policy(model, horizon=None):
    """All policies of actions by state, or by step and state."""
    shape = (model.n_states,) if horizon is None else (horizon, model.n_states)
    choices = itertools.product(range(model.n_actions), repeat=int(np.prod(shape)))
    return [np.reshape(actions, shape) for actions in choices]


def total_rewards(model, policy):
    """The undiscounted value of a policy for each state, by the limit of its chain.

    Infinite, with the sign of what is earned per step, where the chain may settle in a set that
    earns or costs for ever; states that the model never reaches count as ends.
    """
    doing, states = np.eye(model.n_actions)[policy], np.eye(model.n_states)
    chain = np.array([moved_on(model, here, doing) for here in states])
    chain *= np.outer(model.reachable, model.reachable)
    reward = model.expected_reward[np.arange(model.n_states), policy] * model.reachable
    # Where it is after very many steps; the periods of up to three states divide six.
    far = np.mean([np.linalg.matrix_power(chain, 10_000 + k) for k in range(6)], axis=0)
    gain, settled = far @ reward, far.diagonal() > 1e-9
    # Where gains and costs cancel, the sum never settles, and nothing can be said.
    assume(not (settled & (abs(gain) < 1e-9) & (far @ abs(reward) > 0)).any())
    values = np.linalg.solve(states - chain + far, reward)
    for sign in (-1, 1):
        values[far @ (settled & (sign * gain > 1e-9)) > 0] = sign * np.inf
    return values


@settings(max_examples=80)
@given(models(states=3, actions=2, outcomes=2))
def test_undiscounted_planning_against_every_stationary_policy(model):
    totals = np.array([total_rewards(model, policy) for policy in every_policy(model)])
    best = totals.max(axis=0)
    starts = model.initial > 0
    if np.isposinf(best).any() or np.isneginf(best[starts]).any():
        for plan in (mdp.value_iteration, mdp.policy_iteration):
            with pytest.raises(ValueError, match="the undiscounted optimum is not finite"):
                plan(model, 1.0)
        return
    try:
        one, two = mdp.value_iteration(model, 1.0), mdp.policy_iteration(model, 1.0)
    except ValueError as error:
        # The one case that is refused although an optimum exists: resting at no cost and earning
        # at a later cost share a set of states.
        assume("no net cost" not in str(error))
        raise
    np.testing.assert_allclose(one.values, best, rtol=0, atol=1e-9)
    np.testing.assert_allclose(two.values, best, rtol=0, atol=1e-9)
    found = total_rewards(model, one.policy)
    np.testing.assert_allclose(found[starts], best[starts], rtol=0, atol=1e-9)


@settings(max_examples=40)
@given(models(always_ends=True), st.data())
def test_no_time_limit_is_a_distant_one(model, data):
    policy = data.draw(distributions((model.n_states, model.n_actions)))
    success = model.terminated & (model.reward > 0)
    limited = mdp.policy_return(model, policy, 300, success=success)
    unlimited = mdp.policy_return(model, policy, None, success=success)
    for name, value in vars(limited).items():
        assert getattr(unlimited, name) == pytest.approx(value, abs=1e-9), name
    visits = [mdp.state_visitation(model, policy, horizon) for horizon in (None, 300)]
    np.testing.assert_allclose(*visits, atol=1e-9)


def moments_by_recursion(model, chances, discount, success):
    """Figures of `policy_return`, and of each state the mean return and the visits.

    Args:
        chances: the policy at each step, shape (horizon, S, A).
    """
    goes_on = ~model.terminated

    def backed_up(reward, gamma):
        """First and second moments of discounted sums."""
        first = second = np.zeros(model.n_states)
        for now in reversed(chances):
            one, two = goes_on * first[model.next_state], goes_on * second[model.next_state]
            totals = reward + gamma * one, reward**2 + 2 * gamma * reward * one + gamma**2 * two
            first, second = ((now * (model.prob * each).sum(axis=2)).sum(axis=1) for each in totals)
        return first, second

    here, visits = model.initial, 0.0
    for now in chances:
        visits, here = visits + here, moved_on(model, here, now)
    values, squares = backed_up(model.reward, discount)
    lengths, square_lengths = backed_up(np.ones(model.prob.shape), 1.0)
    rate, _ = backed_up((success & model.terminated).astype(float), 1.0)
    backed = np.array([values, squares, lengths, square_lengths, rate])
    mean, square, length, square_length, rate = backed @ model.initial
    return [mean, square - mean**2, length, square_length - length**2, rate], values, visits


KINDS = ["random", "fixed", "changing"]


@settings(max_examples=50)
@given(
    models(), st.integers(1, 30), st.sampled_from([1.0, 0.9, 0]), st.sampled_from(KINDS), st.data()
)
def test_evaluation_against_a_recursion(model, horizon, discount, kind, data):
    """Of a policy that draws, one that does not, and one that changes with the step."""
    policy = data.draw(distributions((model.n_states, model.n_actions)))
    if kind == "fixed":
        policy = np.eye(model.n_actions)[policy.argmax(axis=1)]
    chances = np.array([policy] * horizon)
    if kind == "changing":
        actions = st.integers(0, model.n_actions - 1)
        policy = data.draw(hnp.arrays(np.int64, (horizon, model.n_states), elements=actions))
        chances = np.eye(model.n_actions)[policy]
    success = data.draw(hnp.arrays(np.bool_, model.prob.shape))
    expected, _, visits = moments_by_recursion(model, chances, discount, success)
    np.testing.assert_allclose(mdp.state_visitation(model, policy, horizon), visits, atol=1e-9)
    returns = [
        moments_by_recursion(model, np.array([one] * horizon), discount, success)[0][0]
        for one in mdp.baseline_policies(model)
    ]
    for most_backwards in (2_000_000, 0):
        with pytest.MonkeyPatch.context() as patch:
            # From a limit on, which these models would take minutes to reach, it goes forwards.
            patch.setattr("rl_yardstick.mdp.evaluation.MOST_BACKWARDS", most_backwards)
            found = vars(mdp.policy_return(model, policy, horizon, discount, success))
            baseline = mdp.baseline_return(model, horizon, discount)
        assert baseline == pytest.approx(max(returns), abs=1e-9)
        np.testing.assert_allclose(list(found.values()), expected, rtol=1e-9, atol=1e-9)
    _, values, _ = moments_by_recursion(model, chances, 1.0, success)
    found = mdp.state_values(model, policy, horizon)
    np.testing.assert_allclose(found[model.reachable], values[model.reachable], atol=1e-9)
    assert not found[~model.reachable].any()


@settings(max_examples=40)
@given(models(), st.integers(1, 20))
def test_optimal_actions_followed_by_the_best_plan_earn_the_optimum(model, horizon):
    values, optimal = mdp.optimal_choices(model, horizon)
    plan = mdp.finite_horizon_optimum(model, horizon)
    np.testing.assert_array_equal(values, plan.values)
    assert optimal[np.arange(model.n_states), plan.policy[0]].all()
    reached = model.reachable
    for action in range(model.n_actions):
        first = np.full(model.n_states, action)
        found = mdp.state_values(model, np.vstack([first, plan.policy[1:]]), horizon)
        equal = np.isclose(found, values, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(optimal[reached, action], equal[reached])


@settings(max_examples=40)
@given(models(), st.integers(1, 2000))
def test_what_is_said_of_a_limit_far_away_without_the_steps_is_the_optimum(model, horizon):
    model = replace(model, reward=np.where(model.terminated, model.reward, -1.0))
    found = mdp.optimum_far_from_limit(model, horizon)
    if found is not None:
        expected = mdp.finite_horizon_optimum(model, horizon).start_value
        assert found == pytest.approx(expected, abs=2e-9)
