"""Planning against hand-worked problems and known optima, and the model that it starts from."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rl_yardstick import mdp
from rl_yardstick.mdp.planning import Plan
from tests.mdp.test_evaluation import model_of
from tests.mdp.test_random_models import deterministic, models

PLANNERS = pytest.mark.parametrize("plan", [mdp.value_iteration, mdp.policy_iteration])


OPTIMA = [
    ("Warehouse-v0", {}, 1.0, 79.0, 1e-9),
    ("Warehouse-v0", {}, 0.5, -1.99995, 5e-6),
    # Standing still costs nothing here, and ties with every way to the goal.
    ("Warehouse-v0", {"step_reward": 0}, 1.0, 100.0, 1e-9),
    ("MineMaze-v0", {}, 1.0, 91.0, 1e-9),
    ("FrozenLake-v1", {}, 1.0, 14 / 17, 1e-9),
    ("CliffWalking-v1", {}, 0.9, -(1 - 0.9**13) / 0.1, 1e-9),
]


@PLANNERS
@pytest.mark.parametrize(("env_id", "kwargs", "discount", "optimum", "tolerance"), OPTIMA)
def test_known_optima_are_found_and_earned(plan, env_id, kwargs, discount, optimum, tolerance):
    model = model_of(env_id, **kwargs)
    found = plan(model, discount)
    assert found.start_value == pytest.approx(optimum, abs=tolerance)
    horizon = None if discount == 1 else 1000
    earned = mdp.policy_return(model, found.policy, horizon, discount).expected_return
    assert earned == pytest.approx(found.start_value, abs=1e-8)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "discount", "most"),
    [
        ("RiverSwim-v0", {}, 0.99, 0.7),
        ("Warehouse-v0", {"slip": 0.1}, 0.9, 0.4),
        ("WindyGridworld-v0", {"moves": "king", "stochastic": True}, 1.0, 0.1),
    ],
)
def test_sweeps_that_end_early_say_by_how_much_they_may_be_wrong(env_id, kwargs, discount, most):
    """The error reaches a share of the bound, and never more than the bound."""
    model = model_of(env_id, **kwargs)
    exact = mdp.policy_iteration(model, discount).values
    for tolerance in (1e-3, 0.1):
        found = mdp.value_iteration(model, discount, tolerance)
        error = np.abs(found.values - exact)[model.reachable].max()
        assert most * found.error_bound < error <= found.error_bound <= tolerance


def test_sweeps_that_contract_slowly_are_helped_out():
    """Far from the goal standing still is best, and forgets by the discount alone."""
    model = model_of("RandomWarehouse-v0", size=100, slip=0.1)
    one, two = mdp.value_iteration(model, 0.99), mdp.policy_iteration(model, 0.99)
    assert one.iterations < 100  # sweeps alone take 362
    bound = one.error_bound + two.error_bound
    np.testing.assert_allclose(one.values, two.values, rtol=0, atol=bound)
    # Both planners take the first of the actions that they cannot tell apart.
    gap = two.action_values.max(axis=1) - two.action_values[np.arange(len(one.policy)), one.policy]
    assert gap[model.reachable].max() <= 4 * bound


INF = np.inf
BY_HAND = {  # next states, rewards, ends; the best values of actions, and the policy
    # Both actions of state 0 earn 5 in the end; the first is taken.
    "a tie": ([[1, 1], [0, 0]], [[2, 2], [3, -9]], [[0, 0], [1, 0]], [[5, 5], [3, -4]], [0, 0]),
    # State 1 is entered by termination alone; its own row would earn for ever.
    "a row that is never used": (
        [[1, 0], [1, 1]], [[5, -1], [100, 100]], [[1, 0], [0, 0]], [[5, 4], [0, 0]], [0, 0]),
    # Action 1 of state 0 earns 50 and leads to where every step costs, for ever.
    "a state without end": (
        [[0, 1], [1, 1]], [[3, 50], [-1, -1]], [[1, 0], [0, 0]], [[3, -INF], [-INF, -INF]], [0, 0]),
}  # fmt: skip


@PLANNERS
@pytest.mark.parametrize("name", BY_HAND)
def test_problems_by_hand(plan, name):
    *arrays, action_values, policy = BY_HAND[name]
    found = plan(deterministic(*arrays), 1.0)
    assert found.action_values.tolist() == action_values
    assert found.values.tolist() == np.max(action_values, axis=1).tolist()
    assert found.policy.tolist() == policy


@PLANNERS
@pytest.mark.parametrize(
    ("next_state", "reward", "exits", "message"),
    [
        # Staying pays; going round pays; nothing ends.
        ([[0, 0]], [[1, 0]], True, "action 0 in state 0 earns 1 and can be repeated for ever"),
        ([[1, 0], [0, 0]], [[2, 0], [-1, 0]], True, "action 0 in state 0 earns 2 and can be"),
        ([[1, 1], [0, 0]], [[-1, -1], [-1, -1]], False, "from starting state 0 no policy surely"),
    ],
)
def test_infinite_optima_are_refused(plan, next_state, reward, exits, message):
    terminated = np.zeros(np.shape(reward), bool)
    terminated[:, 1] = exits
    model = deterministic(next_state, reward, terminated)
    with pytest.raises(ValueError, match=f"undiscounted optimum is not finite: .*{message}"):
        plan(model, 1.0)
    assert np.isfinite(plan(model, 0.9).start_value)
    with pytest.raises(ValueError, match="it must lie between 0 and 1"):
        plan(model, 1.1)


@settings(max_examples=40)
@given(models(), st.data())
def test_a_mask_leaves_the_model_without_the_actions_that_it_forbids(model, data):
    mask = data.draw(hnp.arrays(np.bool_, (model.n_states, model.n_actions)))
    states, actions = np.arange(model.n_states), np.arange(model.n_actions)
    mask[states, data.draw(st.sampled_from(actions.tolist()))] = True
    # The first one that is allowed stands in for all that are not.
    rows = states[:, None], np.where(mask, actions, mask.argmax(axis=1)[:, None])
    arrays = {name: getattr(model, name)[rows] for name in ("prob", "next_state", "reward")}
    other = replace(model, **arrays, terminated=model.terminated[rows])
    for plan in (
        partial(mdp.value_iteration, discount=0.9),
        partial(mdp.policy_iteration, discount=0.9),
        partial(mdp.finite_horizon_optimum, horizon=7),
    ):
        found, expected = plan(model, mask=mask), plan(other)
        live = other.reachable
        np.testing.assert_allclose(found.values[live], expected.values[live], atol=1e-8)
        assert mask[states, found.policy][..., model.reachable].all()
        if isinstance(found, Plan):
            assert (np.isneginf(found.action_values) == ~mask)[live].all()


def test_masks_that_leave_no_way_are_refused():
    # Action 0 ends the episode, action 1 stays at a cost.
    model = deterministic([[0, 0]], [[5, -1]], [[True, False]])
    assert mdp.value_iteration(model, 1.0, mask=np.array([[True, False]])).start_value == 5
    with pytest.raises(ValueError, match="no policy surely ends"):
        mdp.value_iteration(model, 1.0, mask=np.array([[False, True]]))
    for plan in (mdp.value_iteration, mdp.policy_iteration, mdp.finite_horizon_optimum):
        with pytest.raises(ValueError, match=r"^the mask allows nothing in state 0$"):
            plan(model, 1, mask=np.zeros((1, 2), bool))


def arrays():
    """Two states, two actions, at most two outcomes; the second state is never entered alive."""
    return {
        "prob": np.array([[[0.25, 0.75], [1.0, 0.0]], [[1.0, 0.0], [0.5, 0.5]]]),
        "next_state": np.array([[[0, 1], [0, 0]], [[1, 0], [0, 1]]]),
        "reward": np.array([[[2.0, 4.0], [-1.0, 99.0]], [[0.0, 0.0], [7.0, 7.0]]]),
        "terminated": np.array([[[False, True], [False, False]], [[False, False], [False, False]]]),
        "initial": np.array([1.0, 0.0]),
        "reward_variance": np.ones((2, 2, 2)),
    }


def test_sizes_and_derived_arrays():
    model = mdp.TransitionModel(**arrays())
    assert (model.n_states, model.n_actions, model.n_outcomes) == (2, 2, 2)
    assert model.expected_reward.tolist() == [[3.5, -1.0], [0.0, 7.0]]
    assert model.reachable.tolist() == [True, False]


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("prob", (1, 0, 0), 0.9, "state 1, action 0 has probabilities that do not sum to one"),
        ("prob", (0, 1), [1.5, -0.5], r"state 0, action 1 has a probability outside \[0, 1\]"),
        ("next_state", (1, 1, 0), 2, r"state 1, action 1 has a next state outside 0..1"),
        ("reward", (0, 0, 1), np.inf, "state 0, action 0 has a reward that is not finite"),
        ("reward_variance", (1, 0, 1), -1, "state 1, action 0 has a variance of the reward"),
        ("initial", 0, 0.5, r"initial holds no probabilities that sum to one: \[0.5 0. \]"),
    ],
)
def test_wrong_arrays_are_refused(name, place, value, message):
    given = arrays()
    given["prob"][1, 1] = [0.5, 0.5 + 5e-10]  # rounding is accepted
    mdp.TransitionModel(**given)
    given[name][place] = value
    with pytest.raises(ValueError, match=message):
        mdp.TransitionModel(**given)
    with pytest.raises(ValueError, match=r"prob has shape \(2, 4\)"):
        mdp.TransitionModel(**{**given, "prob": given["prob"].reshape(2, 4)})


def test_from_gymnasium_pads_keeps_the_order_and_refuses_gaps():
    outcomes = [(0.25, 1, 1.0, True), (0.5, 0, 2.0, False), (0.25, 1, 1.0, True)]
    P = {  # noqa: N806 (Gymnasium's own name)
        0: {0: outcomes, 1: [(1.0, 1, 3.0, False)]},
        1: {0: [(1.0, 0, 4.0, False)], 1: [(1.0, 1, 5.0, True)]},
    }
    model = mdp.TransitionModel.from_gymnasium(P, [1, 0])
    assert model.prob[0].tolist() == [[0.25, 0.5, 0.25], [1.0, 0.0, 0.0]]
    assert model.next_state[0, 0].tolist() == [1, 0, 1]
    assert model.reward[:, 1, 0].tolist() == [3.0, 5.0]
    assert model.terminated[0, 0].tolist() == [True, False, True]
    row = {0: [(1.0, 0, 0.0, True)]}
    for broken, message in (
        ({0: row, 2: {}}, "P has no state 1"),
        ({0: row, 1: {}}, "state 1 must have the actions 0 to 0"),
    ):
        with pytest.raises(ValueError, match=message):
            mdp.TransitionModel.from_gymnasium(broken, np.ones(len(broken)) / len(broken))
