"""Planning against hand-worked problems, brute force, and known optima of real environments."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from mdp import (
    finite_horizon_optimum,
    optimum_far_from_limit,
    policy_iteration,
    policy_return,
    value_iteration,
)
from mdp.advantages import discounted_values
from tests.mdp.worlds import deterministic, model_of, random_world

PLANNERS = pytest.mark.parametrize("plan", [value_iteration, policy_iteration])


# --- known optima ---------------------------------------------------------------------------------

OPTIMA = [
    ("Warehouse-v0", {}, 1.0, 79.0, 1e-9),
    ("Warehouse-v0", {"shelf_reward": -1}, 0.9, 2.0361, 5e-5),
    ("Warehouse-v0", {}, 0.5, -1.99995, 5e-6),
    # Standing still costs nothing here, and ties with every way to the goal.
    ("Warehouse-v0", {"step_reward": 0}, 1.0, 100.0, 1e-9),
    ("MineMaze-v0", {}, 1.0, 91.0, 1e-9),
    ("FrozenLake-v1", {}, 1.0, 14 / 17, 1e-9),
    ("FrozenLake-v1", {"is_slippery": False}, 0.9, 0.9**5, 1e-12),
    ("CliffWalking-v1", {}, 1.0, -13.0, 1e-9),
    ("CliffWalking-v1", {}, 0.9, -(1 - 0.9**13) / 0.1, 1e-9),
]


@PLANNERS
@pytest.mark.parametrize(("env_id", "kwargs", "discount", "optimum", "tolerance"), OPTIMA)
def test_known_optima_are_found_and_earned(plan, env_id, kwargs, discount, optimum, tolerance):
    model = model_of(env_id, **kwargs)
    found = plan(model, discount)
    assert found.start_value == pytest.approx(optimum, abs=tolerance)
    horizon = None if discount == 1 else 1000
    earned = policy_return(model, found.policy, horizon, discount).expected_return
    assert earned == pytest.approx(found.start_value, abs=1e-8)


EIGHT = {"map_name": "8x8"}


@pytest.mark.parametrize(
    ("env_id", "kwargs", "horizon", "optimum", "by_discount"),
    [  # the optimum under the time limit, and what the optimum discounted by 0.99 earns under it
        ("Warehouse-v0", {}, 1000, 79.0, 79.0),
        ("Warehouse-v0", {}, 21, -21.0, -21.0),
        ("FrozenLake-v1", {}, 100, 0.7442, 0.7402),
        ("FrozenLake-v1", EIGHT, 200, 0.9132, 0.8630),
    ],
)
def test_optima_under_a_time_limit(env_id, kwargs, horizon, optimum, by_discount):
    model = model_of(env_id, **kwargs)
    found = finite_horizon_optimum(model, horizon)
    assert found.start_value == pytest.approx(optimum, abs=5e-5)
    for policy, expected in (
        (found.policy, found.start_value),
        (value_iteration(model, 0.99).policy, by_discount),
    ):
        earned = policy_return(model, policy, horizon).expected_return
        assert earned == pytest.approx(expected, abs=5e-5)


def test_a_time_limit_out_of_reach_costs_no_memory():
    found = finite_horizon_optimum(model_of("Warehouse-v0"), 10**6)
    assert found.actions_left.dtype == np.uint8
    assert len(found.actions_left) < 40
    np.testing.assert_array_equal(found.actions(0), found.actions(10**6 - 40))
    with pytest.raises(ValueError, match="step is 1000000, it must lie between 0 and 999999"):
        found.actions(10**6)


@pytest.mark.parametrize("slip", [0.0, 0.1])
def test_a_large_warehouse(slip):
    """Ten thousand states; a million are in the benchmark."""
    model = model_of("RandomWarehouse-v0", size=100, slip=slip, max_episode_steps=5000)
    found = value_iteration(model, 1.0)
    assert found.error_bound < 1e-6
    # Every state bears out Bellman's equation, and the policy earns what the values promise.
    np.testing.assert_allclose(found.values, found.action_values.max(axis=1), rtol=0, atol=1e-9)
    earned = policy_return(model, found.policy, 5000).expected_return
    assert earned == pytest.approx(found.start_value, abs=1e-6)
    assert optimum_far_from_limit(model, 5000) == pytest.approx(found.start_value, abs=1e-6)
    if slip:  # far from the goal standing still is best, and forgets by the discount alone
        one, two = value_iteration(model, 0.99), policy_iteration(model, 0.99)
        assert one.iterations < 100  # sweeps alone take 362
        bound = one.error_bound + two.error_bound
        np.testing.assert_allclose(one.values, two.values, rtol=0, atol=bound)
        # Both planners take the first of the actions that they cannot tell apart.
        taken = two.action_values[np.arange(len(one.policy)), one.policy]
        assert (two.values - taken)[model.reachable].max() <= 4 * bound


# --- problems worked by hand ----------------------------------------------------------------------

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
    # Staying costs nothing: better than an exit that costs, worse than one that pays.
    "staying is better": ([[0, 0]], [[0, -2]], [[0, 1]], [[0, -2]], [0]),
    "the exit is better": ([[0, 0]], [[0, 2]], [[0, 1]], [[2, 2]], [1]),
    "staying costs": ([[0, 0]], [[-1, -2]], [[0, 1]], [[-3, -2]], [1]),
    # Round the loop: +1 - 3. Once through its better half, then out: 1 + 4.
    "a loop that costs more than it earns": (
        [[1, 0], [0, 0]], [[1, 0], [-3, 4]], [[0, 1], [0, 1]], [[5, 0], [2, 4]], [0, 1]),
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
        # Staying pays; going round pays; going round pays one way what it costs the other.
        ([[0, 0]], [[1, 0]], True, "action 0 in state 0 earns 1 and can be repeated for ever"),
        ([[1, 0], [0, 0]], [[2, 0], [-1, 0]], True, "action 0 in state 0 earns 2 and can be"),
        ([[1, 0], [0, 0]], [[-1, 0], [1, 0]], True, "action 0 in state 1 earns 1 and can be"),
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


def test_what_is_best_depends_on_the_steps_left():
    # Two steps to 10, or 1 at once: with a single step left only the 1 can be had.
    model = deterministic([[1, 0], [0, 0]], [[0, 1], [10, 0]], [[False, True], [True, True]])
    for horizon, first_actions in ((3, [0, 0, 1]), (2, [0, 1])):
        found = finite_horizon_optimum(model, horizon)
        assert found.values.tolist() == [10.0, 10.0]
        assert found.policy[:, 0].tolist() == first_actions
        assert [found.actions(step)[0] for step in range(horizon)] == first_actions


# --- among the actions that a mask allows ---------------------------------------------------------


def masked_world(seed):
    """A random world that may begin in any state, and a mask that allows something everywhere."""
    model, groups = random_world(seed, n_actions=3)
    mask = np.random.default_rng(seed).random((4, 3)) < 0.5
    mask[np.arange(4), groups] = True
    return replace(model, initial=np.full(4, 0.25)), mask


@pytest.mark.parametrize("seed", range(4))
def test_no_allowed_policy_is_better(seed):
    model, mask = masked_world(seed)
    policies = np.array([*itertools.product(*(np.flatnonzero(row) for row in mask))])
    best = np.max([discounted_values(model, np.eye(3)[p], 0.9).values for p in policies], axis=0)
    values = np.zeros(4)
    for _ in range(7):
        later = np.where(model.terminated, 0.0, values[model.next_state])
        gains = model.expected_reward + (model.prob * later).sum(axis=2)
        values = np.where(mask, gains, -np.inf).max(axis=1)
    for plan, expected in (
        (value_iteration(model, 0.9, mask=mask), best),
        (policy_iteration(model, 0.9, mask=mask), best),
        (finite_horizon_optimum(model, 7, mask=mask), values),
    ):
        np.testing.assert_allclose(plan.values, expected, atol=1e-8)
        assert mask[np.arange(4), plan.policy].all()
    found = value_iteration(model, 0.9, mask=mask)
    assert (np.isneginf(found.action_values) == ~mask).all()


# --- refusals -------------------------------------------------------------------------------------


def test_masks_that_leave_no_way_are_refused():
    # Action 0 ends the episode, action 1 stays at a cost.
    model = deterministic([[0, 0]], [[5, -1]], [[True, False]])
    assert value_iteration(model, 1.0, mask=np.array([[True, False]])).start_value == 5
    with pytest.raises(ValueError, match="no policy surely ends"):
        value_iteration(model, 1.0, mask=np.array([[False, True]]))
    model, mask = masked_world(0)
    with pytest.raises(ValueError, match=r"^the mask has shape \(3, 4\), it must be \(4, 3\)$"):
        value_iteration(model, 0.9, mask=mask.T)
    mask[2] = False
    for plan in (value_iteration, policy_iteration, finite_horizon_optimum):
        with pytest.raises(ValueError, match=r"^the mask allows nothing in state 2$"):
            plan(model, 1, mask=mask)


def test_arguments_out_of_range():
    model = deterministic([[0]], [[0]], [[True]])
    for discount in (-0.1, 1.1, float("nan")):
        for call in (
            lambda: value_iteration(model, discount),  # noqa: B023
            lambda: policy_iteration(model, discount),  # noqa: B023
            lambda: finite_horizon_optimum(model, 5, discount),  # noqa: B023
            lambda: policy_return(model, np.zeros(1, int), 5, discount),  # noqa: B023
        ):
            with pytest.raises(ValueError, match="it must lie between 0 and 1"):
                call()
    with pytest.raises(ValueError, match="tolerance is 0, it must be positive"):
        value_iteration(model, 1.0, tolerance=0)
    with pytest.raises(ValueError, match="horizon is 0, it must be at least 1"):
        finite_horizon_optimum(model, 0)
