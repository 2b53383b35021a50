"""Planning among the actions that a mask allows, against all policies there are."""

import itertools

import numpy as np
import pytest

from mdp import TransitionModel, finite_horizon_optimum, policy_iteration, value_iteration

STATES, ACTIONS, OUTCOMES = 4, 3, 2


def drawn(seed: int) -> tuple[TransitionModel, np.ndarray]:
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


def values_of(model: TransitionModel, policy: np.ndarray, discount: float) -> np.ndarray:
    """Values of a stationary policy, by the linear system."""
    rows = np.arange(STATES)
    follow = np.zeros((STATES, STATES))
    for state, k in itertools.product(rows, range(OUTCOMES)):
        if not model.terminated[state, policy[state], k]:
            reached = model.next_state[state, policy[state], k]
            follow[state, reached] += model.prob[state, policy[state], k]
    reward = model.expected_reward[rows, policy]
    return np.linalg.solve(np.eye(STATES) - discount * follow, reward)


@pytest.mark.parametrize("plan", [value_iteration, policy_iteration])
@pytest.mark.parametrize("seed", range(20))
def test_no_allowed_policy_is_better(plan, seed):
    model, mask = drawn(seed)
    choices = [np.flatnonzero(row) for row in mask]
    policies = [np.array(policy) for policy in itertools.product(*choices)]
    best = np.max([values_of(model, policy, 0.9) for policy in policies], axis=0)
    found = plan(model, 0.9, mask=mask)
    np.testing.assert_allclose(found.values, best, atol=1e-8)
    assert mask[np.arange(STATES), found.policy].all()
    assert (np.isneginf(found.action_values) == ~mask).all()


@pytest.mark.parametrize("seed", range(20))
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
