"""The Markov chain that a policy makes of a decision process, and linear systems on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Bools, Floats, Ints
from mdp.graph import reachable_states, steps_to_end
from mdp.transition_model import TransitionModel

LARGEST_DENSE = 300


@dataclass(frozen=True, eq=False)
class PolicyChain:
    """The outcomes that happen under a stationary policy, one entry each.

    Attributes:
        model: the decision process.
        used: the actions that the policy takes, bool of shape (S, A).
        states: the states of the chain, shape (n,); rows and following states below are places
            in this array.
        row: where each outcome happens, shape (m,).
        weight: its probability under the policy, shape (m,).
        following: where it leads, shape (m,); of no meaning where it ends the episode.
        outcome: its flat index into the arrays of the model, shape (m,).
    """

    model: TransitionModel
    used: Bools
    states: Ints
    row: Ints
    weight: Floats
    following: Ints
    outcome: Ints

    @classmethod
    def build(
        cls, model: TransitionModel, policy: Floats, states: Bools | None = None
    ) -> PolicyChain:
        """The chain of a policy matrix (S, A), on the states it visits or on those given.

        ``states``, bool of shape (S,), must be closed under the policy.
        """
        if states is None:
            states = reachable_states(model, policy > 0)
        listed = np.flatnonzero(states)
        place = np.cumsum(states) - 1
        weight = (policy[listed][:, :, None] * model.prob[listed]).ravel()
        entry = np.flatnonzero(weight)
        size = model.n_actions * model.n_outcomes
        row = entry // size
        outcome = listed[row] * size + entry % size
        following = place[model.next_state.ravel()[outcome]]
        return cls(model, policy > 0, listed, row, weight[entry], following, outcome)

    @cached_property
    def reward(self) -> Floats:
        """The reward of each outcome, shape (m,)."""
        return self.model.reward.ravel()[self.outcome]

    @cached_property
    def terminated(self) -> Bools:
        """Whether each outcome ends the episode, bool of shape (m,)."""
        return self.model.terminated.ravel()[self.outcome]

    @cached_property
    def endless(self) -> Bools:
        """The states from which the episode never ends, bool of shape (n,)."""
        nowhere = np.zeros(self.model.n_states, np.bool_)
        steps, _ = steps_to_end(self.model, self.used, nowhere)
        return steps[self.states] < 0

    @property
    def size(self) -> int:
        """The number of states, n."""
        return len(self.states)

    def mean(self, per_outcome: NDArray[np.floating] | Bools) -> Floats:
        """The expectation of a quantity (m,) of one step's outcome, for each state (n,)."""
        total = np.bincount(self.row, weights=self.weight * per_outcome, minlength=self.size)
        return total.astype(np.float64)

    def after(self, values: Floats) -> Floats:
        """The value (n,) of the state that each outcome leads to (m,): zero where none follows."""
        return np.where(self.terminated, 0.0, values[self.following])

    def spread(self, result: Floats, mean: Floats) -> Floats:
        """The mean square (n,) by which a result per outcome (m,) differs from its mean (n,)."""
        return self.mean((result - mean[self.row]) ** 2)

    def solve(
        self,
        right: Floats,
        discount: float,
        *,
        zero: Bools | None = None,
        transposed: bool = False,
    ) -> Floats:
        """Solve (I - discount P) x = right, where P are the probabilities of going on.

        With a reward per step on the right, x is the expected sum until the episode ends; the
        transposed system, with the starting distribution, gives the expected visits.

        Args:
            right: shape (n,).
            discount: from 0 to 1; without discount the episode must end, or x be known to be
                zero, wherever the chain may settle.
            zero: states where x is zero, bool of shape (n,).
            transposed: solve the transposed system.
        """
        kept = np.ones(self.size, np.bool_) if zero is None else ~zero
        leads = ~self.terminated & kept[self.row] & kept[self.following]
        place = np.cumsum(kept) - 1
        row, following = place[self.row[leads]], place[self.following[leads]]
        if transposed:
            row, following = following, row
        result = np.zeros(self.size)
        result[kept] = _solve(row, following, -discount * self.weight[leads], right[kept])
        return result


def _solve(row: Ints, column: Ints, weight: Floats, right: Floats) -> Floats:
    """Solve (I + W) x = right, with the entries of W given one by one."""
    n = len(right)
    if n <= LARGEST_DENSE:
        matrix = np.eye(n)
        np.add.at(matrix, (row, column), weight)
        return np.linalg.solve(matrix, right).astype(np.float64)
    from scipy.sparse import csc_array, eye_array
    from scipy.sparse.linalg import splu

    system = eye_array(n, format="csc") + csc_array((weight, (row, column)), shape=(n, n))
    solution: Floats = splu(system).solve(right)
    return solution
