"""What planning says of its own error, against the error itself, in exact fractions."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from mdp import TransitionModel, policy_iteration, value_iteration

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


N_MODELS = 10


@pytest.mark.parametrize("scale", [1e-3, 1e9])
@pytest.mark.parametrize("discount", [0.5, 0.9, 0.99, 1.0])
def test_bounds_are_never_below_the_error_and_not_far_above(discount, scale):
    """Without discount each step costs something and may end the episode: the bound is proven.

    Since some models reach the bound of sweeps up to one sweep, it is not far above the error.
    """
    costly, shares = discount == 1, {1e-10: [], 1e-3: [], 1.0: []}
    rounding = 10_000 if costly else 32 / (1 - discount)
    for seed in range(N_MODELS):
        model = drawn_model(seed, scale, costly=costly)
        exact = exact_optimum(model, discount)
        for tolerance, found in shares.items():
            plan = value_iteration(model, discount, tolerance * scale)
            error = true_error(plan.values, exact)
            assert error <= plan.error_bound
            assert plan.error_bound <= max(tolerance * scale, rounded(plan.values, rounding))
            found.append(float(error / Fraction(plan.error_bound)))
        plan = policy_iteration(model, discount)  # that of a solved system is rounding alone
        assert true_error(plan.values, exact) <= plan.error_bound
        assert plan.error_bound <= rounded(plan.values, rounding)
    for tolerance in (1e-3, 1.0):
        # A sweep brings values nearer by the discount: that much of the bound is error at most.
        assert (0.2 if costly else 0.85 * discount) < max(shares[tolerance]) <= discount


def rounded(values, times):
    """So many times what rounding may do to the largest of some values."""
    return times * EPSILON * max(1.0, float(np.abs(values).max()))
