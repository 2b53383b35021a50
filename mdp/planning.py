"""The best policy of a finite Markov decision process, and its values.

Without a time limit the best policy is stationary; for the best one under a time limit, which is
not, see ``mdp.finite_horizon``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mdp.chain import PolicyChain
from mdp.graph import steps_to_end
from mdp.model import TransitionModel
from mdp.sweeps import (
    TIE_TOLERANCE,
    action_values,
    evaluate,
    first_guess,
    improve,
    policy_rows,
)
from mdp.undiscounted import FinitePart, finite_part

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

EPSILON = float(np.finfo(np.float64).eps)
# Beyond this many rounds only plain sweeps are made, which are known to converge.
ROUNDS_WITH_EVALUATION = 1000
SWEEPS_PER_EVALUATION = 30


@dataclass(frozen=True, eq=False)
class Plan:
    """An optimal stationary policy.

    Attributes:
        values: the optimal expected (discounted) sum of rewards from each state, shape (S,); zero
            for states that cannot be reached, minus infinity for those from which no policy
            surely ends an undiscounted episode.
        action_values: the same after taking each action first, shape (S, A); minus infinity for
            actions that cannot be part of a finite value, and in unreachable states.
        policy: the greedy action in each state, shape (S,): the first of those whose values
            differ by less than 1e-12 of the best, or twice the error bound where that is more.
            Without discount, where staying at no cost ties with going on, one that goes on.
        iterations: sweeps of value iteration, or policies that policy iteration evaluated.
        error_bound: a bound on the distance between ``values`` and the optimum. It is proven,
            rounding included, with a discount below one and where every step that cannot end the
            episode costs something; elsewhere it is the largest change of the last iteration
            times the expected length of the policy's longest episode.
        start_value: the mean of ``values`` over the starting states.
    """

    values: Floats
    action_values: Floats
    policy: Indices
    iterations: int
    error_bound: float
    start_value: float


def value_iteration(
    model: TransitionModel, discount: float, tolerance: float = 1e-10
) -> Plan:
    """Plan by sweeping the Bellman optimality operator over the states.

    The sweeps are Gauss-Seidel, the states nearest to the end first, and between them the greedy
    policy is evaluated approximately (modified policy iteration: Puterman, Markov Decision
    Processes, 1994, section 6.5), in as many sweeps as it repays. Whether the values have
    converged is judged by the plain sweeps alone.

    Args:
        model: the decision process; rows of unreachable states are ignored.
        discount: from 0 to 1; 1 sums rewards until the episode ends.
        tolerance: sweeping stops when the error bound is at most this, or when values change
            by no more than rounding makes them.

    Raises:
        ValueError: for a discount or tolerance out of range, or where the undiscounted optimum
            is not finite.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance is {tolerance}, it must be positive")
    problem = _Problem(model, discount)
    values, policy = problem.start()
    change = np.inf
    iterations = 0
    while True:
        if problem.may_evaluate(iterations, change, values):
            problem.evaluate_roughly(values, policy, change)
        change = problem.sweep(values, policy)
        iterations += 1
        if change <= problem.rounding(values) or problem.error(values, change) <= tolerance:
            return problem.plan(values, policy, change, iterations)
