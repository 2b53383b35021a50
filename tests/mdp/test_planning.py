"""Planning against hand-worked problems and the known optima of real environments."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from envs.known_models import transition_model
from mdp import (
    TransitionModel,
    finite_horizon_optimum,
    policy_iteration,
    policy_return,
    value_iteration,
)

PLANNERS = pytest.mark.parametrize("plan", [value_iteration, policy_iteration])


def model_of(env_id, **kwargs):
    model = transition_model(gym.make(f"envs:{env_id}", **kwargs))
    assert model is not None
    return model


def deterministic(next_state, reward, terminated, start=0):
    """A model without chance, from arrays of shape (S, A)."""
    following = np.asarray(next_state)[:, :, None]
    return TransitionModel(
        prob=np.ones(following.shape),
        next_state=following,
        reward=np.asarray(reward, float)[:, :, None],
        terminated=np.asarray(terminated, bool)[:, :, None],
        initial=np.eye(len(following))[start],
    )


OPTIMA = [
    ("Warehouse-v0", {}, 1.0, 79.0, 1e-9),
    ("Warehouse-v0", {"shelf_reward": -1}, 1.0, 79.0, 1e-9),
    ("Warehouse-v0", {}, 0.9, 2.0361, 5e-5),
    ("Warehouse-v0", {"shelf_reward": -1}, 0.9, 2.0361, 5e-5),
    ("Warehouse-v0", {}, 0.5, -1.99995, 5e-6),
    ("Warehouse-v0", {}, 0.1, -1.1111, 5e-5),
    ("MineMaze-v0", {}, 1.0, 91.0, 1e-9),
    ("FrozenLake-v1", {}, 1.0, 14 / 17, 1e-9),
    ("FrozenLake-v1", {"is_slippery": False}, 0.9, 0.9**5, 1e-12),
    ("CliffWalking-v1", {}, 1.0, -13.0, 1e-9),
    ("CliffWalking-v1", {}, 0.9, -(1 - 0.9**13) / 0.1, 1e-9),
]


@PLANNERS
@pytest.mark.parametrize(("env_id", "kwargs", "discount", "optimum", "tolerance"), OPTIMA)
def test_known_optima(plan, env_id, kwargs, discount, optimum, tolerance):
    found = plan(model_of(env_id, **kwargs), discount)
    assert found.start_value == pytest.approx(optimum, abs=tolerance)


@pytest.mark.parametrize("discount", [1.0, 0.99])
@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("Warehouse-v0", {"slip": 0.1, "random_start": True}),
        ("FrozenLake-v1", {"map_name": "8x8"}),
        ("Taxi-v4", {"is_rainy": True}),
    ],
)
def test_the_planners_agree_within_their_bounds(env_id, kwargs, discount):
    model = model_of(env_id, **kwargs)
    one, two = value_iteration(model, discount), policy_iteration(model, discount)
    assert max(one.error_bound, two.error_bound) < 2e-9
    np.testing.assert_allclose(
        one.values, two.values, rtol=0, atol=one.error_bound + two.error_bound
    )


@PLANNERS
@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("Warehouse-v0", {"slip": 0.1}),
        ("MineMaze-v0", {}),
        ("FrozenLake-v1", {}),
        # Standing still costs nothing here, and ties with every way to the goal.
        ("FrozenLake-v1", {"is_slippery": False}),
        ("Warehouse-v0", {"step_reward": 0}),
    ],
)
def test_the_greedy_policy_earns_the_optimum(plan, env_id, kwargs):
    model = model_of(env_id, **kwargs)
    found = plan(model, 1.0)
    earned = policy_return(model, found.policy, None).expected_return
    assert earned == pytest.approx(found.start_value, abs=1e-8)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "discount", "horizon", "success"),
    [
        ("FrozenLake-v1", {}, 0.99, 100, 0.7402),
        ("FrozenLake-v1", {}, 0.95, 100, 0.7298),
        ("FrozenLake-v1", {"map_name": "8x8"}, 0.99, 200, 0.8630),
        ("FrozenLake-v1", {"map_name": "8x8"}, 0.95, 200, 0.7386),
    ],
)
def test_greedy_policies_of_the_discounted_optimum(env_id, kwargs, discount, horizon, success):
    model = model_of(env_id, **kwargs)
    policy = value_iteration(model, discount).policy
    earned = policy_return(model, policy, horizon).expected_return
    assert earned == pytest.approx(success, abs=5e-5)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "horizon", "optimum", "tolerance"),
    [
        ("Warehouse-v0", {}, 1000, 79.0, 1e-9),
        ("Warehouse-v0", {}, 21, -21.0, 1e-9),
        ("MineMaze-v0", {}, 100, 91.0, 1e-9),
        ("CliffWalking-v1", {}, 200, -13.0, 1e-9),
        ("FrozenLake-v1", {}, 100, 0.7442, 5e-5),
        ("FrozenLake-v1", {"map_name": "8x8"}, 200, 0.9132, 5e-5),
        ("FrozenLake-v1", {"map_name": "8x8"}, 99, 0.6353, 5e-5),
    ],
)
def test_optima_under_a_time_limit(env_id, kwargs, horizon, optimum, tolerance):
    model = model_of(env_id, **kwargs)
    found = finite_horizon_optimum(model, horizon)
    assert found.start_value == pytest.approx(optimum, abs=tolerance)
    earned = policy_return(model, found.policy, horizon).expected_return
    assert earned == pytest.approx(found.start_value, abs=1e-9)


def test_a_time_limit_out_of_reach_costs_no_memory():
    found = finite_horizon_optimum(model_of("Warehouse-v0"), 10**6)
    assert found.actions_left.dtype == np.uint8
    assert len(found.actions_left) < 40
    np.testing.assert_array_equal(found.actions(0), found.actions(10**6 - 40))
    with pytest.raises(ValueError, match="step is 1000000, it must lie between 0 and 999999"):
        found.actions(10**6)


def test_what_is_best_depends_on_the_steps_left():
    # Two steps to 10, or 1 at once: with a single step left only the 1 can be had.
    model = deterministic([[1, 0], [0, 0]], [[0, 1], [10, 0]], [[False, True], [True, True]])
    found = finite_horizon_optimum(model, 3)
    assert found.values.tolist() == [10.0, 10.0]
    assert found.policy[:, 0].tolist() == [0, 0, 1]
    assert [found.actions(step)[0] for step in range(3)] == [0, 0, 1]
    short = finite_horizon_optimum(model, 2)
    assert [short.actions(step)[0] for step in range(2)] == [0, 1]


@PLANNERS
def test_action_values_and_ties(plan):
    # Both actions of state 0 earn 5 in the end; the first is taken.
    model = deterministic([[1, 1], [0, 0]], [[2, 2], [3, -9]], [[False, False], [True, False]])
    found = plan(model, 1.0)
    assert found.action_values.tolist() == [[5.0, 5.0], [3.0, -4.0]]
    assert found.values.tolist() == [5.0, 3.0]
    assert found.policy.tolist() == [0, 0]


@PLANNERS
@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_rows_that_are_never_used_have_no_say(plan, discount):
    # State 1 is entered by termination alone; its own row would earn for ever.
    model = deterministic([[1, 0], [1, 1]], [[5, -1], [100, 100]], [[True, False], [False, False]])
    found = plan(model, discount)
    assert found.values.tolist() == [5.0, 0.0]
    assert found.action_values[1].tolist() == [0.0, 0.0]
    assert finite_horizon_optimum(model, 50, discount).values.tolist() == [5.0, 0.0]


@PLANNERS
def test_a_state_without_end_is_avoided(plan):
    # Action 1 of state 0 earns 50 and leads to where every step costs, for ever.
    model = deterministic([[0, 1], [1, 1]], [[3, 50], [-1, -1]], [[True, False], [False, False]])
    found = plan(model, 1.0)
    assert found.start_value == 3.0
    assert found.values[1] == -np.inf
    assert found.action_values[0].tolist() == [3.0, -np.inf]
    assert found.policy[0] == 0


@PLANNERS
@pytest.mark.parametrize(
    ("step", "exit_reward", "optimum", "action"),
    # Staying costs nothing: better than an exit that costs, worse than one that pays.
    [(0, -2, 0.0, 0), (0, 2, 2.0, 1), (-1, -2, -2.0, 1), (-1, 2, 2.0, 1)],
)
def test_staying_at_no_cost(plan, step, exit_reward, optimum, action):
    found = plan(deterministic([[0, 0]], [[step, exit_reward]], [[False, True]]), 1.0)
    assert found.start_value == optimum
    assert found.policy.tolist() == [action]


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


@PLANNERS
def test_earning_in_a_loop_that_costs_more_is_no_infinity(plan):
    # Round the loop: +1 - 3. Once through its better half, then out: 1 + 4.
    model = deterministic([[1, 0], [0, 0]], [[1, 0], [-3, 4]], [[False, True], [False, True]])
    found = plan(model, 1.0)
    assert found.values.tolist() == [5.0, 4.0]


@pytest.mark.parametrize("discount", [-0.1, 1.1, float("nan")])
@pytest.mark.parametrize(
    "call",
    [
        value_iteration,
        policy_iteration,
        lambda model, discount: finite_horizon_optimum(model, 5, discount),
        lambda model, discount: policy_return(model, np.zeros(1, int), 5, discount),
    ],
    ids=["value_iteration", "policy_iteration", "finite_horizon_optimum", "policy_return"],
)
def test_discounts_out_of_range(call, discount):
    with pytest.raises(ValueError, match="it must lie between 0 and 1"):
        call(deterministic([[0]], [[0]], [[True]]), discount)


def test_other_arguments_out_of_range():
    model = deterministic([[0]], [[0]], [[True]])
    with pytest.raises(ValueError, match="tolerance is 0, it must be positive"):
        value_iteration(model, 1.0, tolerance=0)
    with pytest.raises(ValueError, match="horizon is 0, it must be at least 1"):
        finite_horizon_optimum(model, 0)


@pytest.mark.parametrize("slip", [0.0, 0.1])
def test_a_large_warehouse(slip):
    """Forty thousand states; a million are in the benchmark."""
    model = model_of("RandomWarehouse-v0", size=200, slip=slip)
    found = value_iteration(model, 1.0)
    assert found.error_bound < 1e-6
    # Every state bears out Bellman's equation, and the policy earns what the values promise.
    best = found.action_values.max(axis=1)
    np.testing.assert_allclose(found.values, best, rtol=0, atol=1e-9)
    earned = policy_return(model, found.policy, 10_000).expected_return
    assert earned == pytest.approx(found.start_value, abs=1e-6)


def test_sweeps_that_contract_slowly_are_helped_out():
    """Far from the goal standing still is best, and forgets by the discount alone."""
    model = model_of("RandomWarehouse-v0", size=100, slip=0.1)
    one, two = value_iteration(model, 0.99), policy_iteration(model, 0.99)
    assert one.iterations < 100  # sweeps alone take 362
    bound = one.error_bound + two.error_bound
    np.testing.assert_allclose(one.values, two.values, rtol=0, atol=bound)
    # Both planners take the first of the actions that they cannot tell apart.
    gap = two.action_values.max(axis=1) - two.action_values[np.arange(len(one.policy)), one.policy]
    assert gap[model.reachable].max() <= 4 * bound


# --- among the actions that a mask allows --------------------------------------------------------

STATES, ACTIONS, OUTCOMES = 4, 3, 2


def drawn(seed):
    """A random model, and a random mask that allows something everywhere."""
    rng = np.random.default_rng(seed)
    shape = (STATES, ACTIONS, OUTCOMES)
    model = TransitionModel(
        prob=rng.dirichlet(np.ones(OUTCOMES), shape[:2]),
        next_state=rng.integers(STATES, size=shape),
        reward=rng.integers(-5, 6, shape).astype(float),
        terminated=rng.random(shape) < 0.2,
        initial=np.full(STATES, 1 / STATES),
    )
    mask = rng.random((STATES, ACTIONS)) < 0.5
    mask[np.arange(STATES), rng.integers(ACTIONS, size=STATES)] = True
    return model, mask


def values_of(model, policy, discount):
    """Values of a stationary policy, by the linear system."""
    rows = np.arange(STATES)
    follow = np.zeros((STATES, STATES))
    for state, k in itertools.product(rows, range(OUTCOMES)):
        if not model.terminated[state, policy[state], k]:
            reached = model.next_state[state, policy[state], k]
            follow[state, reached] += model.prob[state, policy[state], k]
    reward = model.expected_reward[rows, policy]
    return np.linalg.solve(np.eye(STATES) - discount * follow, reward)


@PLANNERS
@pytest.mark.parametrize("seed", range(8))
def test_no_allowed_policy_is_better(plan, seed):
    model, mask = drawn(seed)
    choices = [np.flatnonzero(row) for row in mask]
    policies = [np.array(policy) for policy in itertools.product(*choices)]
    best = np.max([values_of(model, policy, 0.9) for policy in policies], axis=0)
    found = plan(model, 0.9, mask=mask)
    np.testing.assert_allclose(found.values, best, atol=1e-8)
    assert mask[np.arange(STATES), found.policy].all()
    assert (np.isneginf(found.action_values) == ~mask).all()


@pytest.mark.parametrize("seed", range(8))
def test_under_a_time_limit(seed):
    model, mask = drawn(seed)
    values = np.zeros(STATES)
    for _ in range(7):
        later = np.where(model.terminated, 0.0, values[model.next_state])
        gains = model.expected_reward + (model.prob * later).sum(axis=2)
        values = np.where(mask, gains, -np.inf).max(axis=1)
    found = finite_horizon_optimum(model, 7, mask=mask)
    np.testing.assert_allclose(found.values, values, atol=1e-12)
    assert mask[np.arange(STATES), found.policy].all()


def test_without_discount_a_mask_can_leave_no_way_to_the_end():
    # Action 0 ends the episode, action 1 stays at a cost.
    model = TransitionModel(
        prob=np.ones((1, 2, 1)),
        next_state=np.zeros((1, 2, 1), int),
        reward=np.array([[[5.0], [-1.0]]]),
        terminated=np.array([[[True], [False]]]),
        initial=np.ones(1),
    )
    assert value_iteration(model, 1.0, mask=np.array([[True, False]])).start_value == 5
    with pytest.raises(ValueError, match="no policy surely ends"):
        value_iteration(model, 1.0, mask=np.array([[False, True]]))


def test_malformed_masks():
    model, mask = drawn(0)
    with pytest.raises(ValueError, match=r"^the mask has shape \(3, 4\), it must be \(4, 3\)$"):
        value_iteration(model, 0.9, mask=mask.T)
    mask[2] = False
    for plan in (value_iteration, policy_iteration, finite_horizon_optimum):
        with pytest.raises(ValueError, match=r"^the mask allows nothing in state 2$"):
            plan(model, 1, mask=mask)
