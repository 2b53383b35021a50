"""What planning says of its own error, against the error itself, in exact fractions."""

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from mdp import TransitionModel, policy_iteration, value_iteration
from mdp.graph import steps_to_end
from mdp.planning import FinitePart, PlanningProblem

STATES, ACTIONS, OUTCOMES = 3, 2, 2
EPSILON = float(np.finfo(np.float64).eps)


def drawn_model(seed, scale, *, costly=False):
    """A model whose probabilities are eighths, so that nothing is rounded in writing them down.

    With ``costly``, every step costs something and ends the episode with a chance of an eighth.
    """
    rng = np.random.default_rng(seed)
    shape = (STATES, ACTIONS, OUTCOMES)
    first = rng.integers(1, 8, size=shape[:2]) / 8
    terminated = np.zeros(shape, np.bool_)
    reward = scale * rng.integers(-8, 9, size=shape)
    prob = np.stack([first, 1 - first], axis=2)
    if costly:
        prob[:] = 7 / 8, 1 / 8
        terminated[..., 1] = rng.random(shape[:2]) < 0.7
        terminated[:, 0, 1] = True
        reward[~terminated] = -scale * rng.integers(1, 9, size=(~terminated).sum())
    return TransitionModel(
        prob=prob,
        next_state=rng.integers(STATES, size=shape),
        reward=reward,
        terminated=terminated,
        initial=np.full(STATES, 1 / STATES),
    )


def solved(matrix):
    """The solution of the equations in the rows of a matrix; its last column is the right side."""
    size = len(matrix)
    for i in range(size):
        pivot = next((j for j in range(i, size) if matrix[j][i]), None)
        if pivot is None:
            return None
        matrix[i], matrix[pivot] = matrix[pivot], matrix[i]
        matrix[i] = [entry / matrix[i][i] for entry in matrix[i]]
        for j in range(size):
            if j != i:
                factor = matrix[j][i]
                matrix[j] = [a - factor * b for a, b in zip(matrix[j], matrix[i], strict=True)]
    return [row[-1] for row in matrix]


def exact_optimum(model, discount):
    """The best value of each state over all stationary policies that surely come to an end."""
    gamma, found = Fraction(discount), []
    for policy in itertools.product(range(ACTIONS), repeat=STATES):
        rows = []
        for state, action in enumerate(policy):
            row = [Fraction(int(state == other)) for other in range(STATES)] + [Fraction(0)]
            for k in range(OUTCOMES):
                chance = Fraction(float(model.prob[state, action, k]))
                row[-1] += chance * Fraction(float(model.reward[state, action, k]))
                if not model.terminated[state, action, k]:
                    row[model.next_state[state, action, k]] -= gamma * chance
            rows.append(row)
        values = solved(rows)
        if values is not None:
            found.append(values)
    return [max(values) for values in zip(*found, strict=True)]


def true_error(values, exact):
    return max(abs(Fraction(float(v)) - e) for v, e in zip(values, exact, strict=True))


SCALES = (1e-3, 1.0, 1e9)
DISCOUNTS = (0.5, 0.9, 0.99)
N_MODELS = 10


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("tolerance", [1e-10, 1e-3, 1.0])
@pytest.mark.parametrize("discount", DISCOUNTS)
def test_the_bound_of_discounted_sweeps(discount, tolerance, scale):
    """Never below the error; and since some models reach it up to one sweep, not far above."""
    shares = []
    for seed in range(N_MODELS):
        model = drawn_model(seed, scale)
        plan = value_iteration(model, discount, tolerance * scale)
        error = true_error(plan.values, exact_optimum(model, discount))
        assert error <= plan.error_bound
        assert plan.error_bound <= max(tolerance * scale, rounded(plan.values, 32) / (1 - discount))
        shares.append(float(error / Fraction(plan.error_bound)))
    if tolerance > 1e-10:
        # A sweep brings values nearer by the discount: that much of the bound is error at most.
        assert 0.85 * discount < max(shares) <= discount


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("discount", DISCOUNTS)
def test_the_bound_of_a_solved_system_is_rounding(discount, scale):
    for seed in range(N_MODELS):
        model = drawn_model(seed, scale)
        plan = policy_iteration(model, discount)
        assert true_error(plan.values, exact_optimum(model, discount)) <= plan.error_bound
        assert plan.error_bound <= rounded(plan.values, 32) / (1 - discount)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("tolerance", [1e-10, 1e-3, 1.0])
def test_the_bound_without_discount(tolerance, scale):
    """Each step costs something and may end the episode, so that the bound is proven."""
    shares = []
    for seed in range(N_MODELS):
        model = drawn_model(seed, scale, costly=True)
        exact = exact_optimum(model, 1.0)
        plan = value_iteration(model, 1.0, tolerance * scale)
        error = true_error(plan.values, exact)
        assert error <= plan.error_bound
        assert plan.error_bound <= max(tolerance * scale, rounded(plan.values, 10_000))
        shares.append(float(error / Fraction(plan.error_bound)))
        solved_plan = policy_iteration(model, 1.0)
        assert true_error(solved_plan.values, exact) <= solved_plan.error_bound
        assert solved_plan.error_bound <= rounded(solved_plan.values, 10_000)
    if tolerance > 1e-10:
        assert 0.2 < max(shares) <= 1


@pytest.mark.parametrize(
    ("change", "bound"), [(0.0, 0.0), (0.25, 2 / 3), (0.5, 2.0), (1 - 1e-9, 2e9), (1.0, np.inf)]
)
def test_the_bound_without_discount_by_hand(change, bound):
    """A step costs 1 and ends the episode with a chance of 1/2: M is 0, and the value -2."""
    model = TransitionModel(
        prob=np.array([[[0.5, 0.5]]]),
        next_state=np.zeros((1, 1, 2), np.int64),
        reward=np.full((1, 1, 2), -1.0),
        terminated=np.array([[[False, True]]]),
        initial=np.ones(1),
    )
    problem = PlanningProblem(model, 1.0, replace(FinitePart.everything(model), step_cost=1.0))
    assert problem.error_bound(np.array([-2.0]), change) == pytest.approx(
        bound, rel=1e-5, abs=1e-13
    )


def rounded(values, times):
    """So many times what rounding may do to the largest of some values."""
    return times * EPSILON * max(1.0, float(np.abs(values).max()))


@pytest.mark.parametrize(("bounds_apart", "chosen"), [(0.0, 0), (1.9, 0), (2.1, 1), (2.9, 1)])
def test_what_lies_within_twice_the_bound_is_a_tie(bounds_apart, chosen):
    """Three states take many sweeps; beside them stands one whose actions end the episode."""
    slow = drawn_model(0, 1.0)

    def plan_with(gap):
        def with_fourth(array, row):
            return np.concatenate([array, [row]])

        return value_iteration(
            TransitionModel(
                prob=with_fourth(slow.prob, [[1, 0], [1, 0]]),
                next_state=with_fourth(slow.next_state, [[0, 0], [0, 0]]),
                reward=with_fourth(slow.reward, [[1 - gap, 0], [1, 0]]),
                terminated=with_fourth(slow.terminated, [[True, True], [True, True]]),
                initial=np.full(4, 0.25),
            ),
            discount=0.99,
            tolerance=0.01,
        )

    bound = plan_with(0.0).error_bound
    assert 1e-4 < bound <= 0.01
    plan = plan_with(bounds_apart * bound)
    assert plan.error_bound == bound
    assert plan.policy[3] == chosen


def test_steps_to_the_end_or_to_a_target_are_the_fewest():
    """A line of six: the first is a target, the fourth may end the episode, the last only stays."""
    following = [[0], [0], [1], [4], [3], [5]]
    model = TransitionModel(
        prob=np.tile([0.5, 0.5], (6, 1, 1)),
        next_state=np.repeat(np.array(following)[:, None], 2, axis=2),
        reward=np.zeros((6, 1, 2)),
        terminated=np.array([[[False, state == 3]] for state in range(6)]),
        initial=np.full(6, 1 / 6),
    )
    allowed = np.ones((6, 1), np.bool_)
    steps, order = steps_to_end(model, allowed, np.arange(6) == 0)
    assert steps.tolist() == [0, 1, 2, 1, 2, -1]
    assert order.tolist() == [0, 3, 1, 4, 2] or order.tolist() == [0, 3, 1, 2, 4]
    assert steps[order].tolist() == [0, 1, 1, 2, 2]
