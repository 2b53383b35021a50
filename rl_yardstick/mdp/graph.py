"""Reachability between states, and the Markov chain that a policy induces.

Functions with an argument ``allowed``, bool of shape (S, A), consider these actions only. Outcomes
of probability zero are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import compiled
from rl_yardstick.mdp.transition_model import AnyInts, Bools, Floats, Ints, TransitionModel


def steps_to_end(model: TransitionModel, allowed: Bools, target: Bools) -> tuple[Ints, Ints]:
    """The fewest transitions of positive probability to a termination or to a target state.

    Returns:
        The number of steps, shape (S,): 0 for target states, -1 where neither can be reached. And
        the states that can reach one, in ascending order of steps.
    """
    ends = (model.terminated & (model.prob > 0) & allowed[:, :, None]).any(axis=(1, 2))
    steps = np.where(target, 0, np.where(ends, 1, -1))
    order = np.empty(model.n_states, np.int64)
    nearest = np.concatenate([np.flatnonzero(steps == 0), np.flatnonzero(steps == 1)])
    order[: len(nearest)] = nearest
    leads = model.goes_on & allowed[:, :, None]
    found = _search_backwards(leads, model.next_state, steps, order, len(nearest))
    return steps, order[:found]


def end_components(model: TransitionModel, allowed: Bools) -> tuple[Ints, Bools]:
    """The maximal end components: sets of states in which an agent can stay for ever.

    An end component is a set of states and actions such that no outcome ends the episode or
    leaves the set, and each state can be reached from each other (de Alfaro, Formal Verification
    of Probabilistic Systems, 1997, section 3.3).

    Returns:
        The number of each state's component, shape (S,), -1 for states in none; and the actions
        that stay within the component, bool of shape (S, A).
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    possible = model.prob > 0
    inside = allowed & ~(possible & model.terminated).any(axis=2)
    while True:
        edges = possible & inside[:, :, None]
        states = np.nonzero(edges)[0]
        ends = np.ones(len(states), np.int8), (states, model.next_state[edges])
        graph = csr_array(ends, shape=(model.n_states, model.n_states))
        _, label = connected_components(graph, connection="strong")
        same = label[model.next_state] == label[:, None, None]
        kept = inside & (same | ~possible).all(axis=2)
        if np.array_equal(kept, inside):
            return np.where(kept.any(axis=1), label, -1).astype(np.int64), kept
        inside = kept


@compiled
def _search_backwards(
    leads: Bools, next_state: AnyInts, steps: Ints, order: Ints, found: int
) -> int:
    """Breadth-first search from the first ``found`` states of ``order``; the number then found."""
    flat, reached, n_each = leads.ravel(), next_state.ravel(), leads[0].size
    # The outcomes that lead to each state: the first one, and after each outcome the next one.
    first, following = np.full(len(steps), -1, np.int32), np.empty(flat.size, np.int32)
    for outcome in range(flat.size - 1, -1, -1):
        if flat[outcome]:
            following[outcome] = first[reached[outcome]]
            first[reached[outcome]] = outcome
    done = 0
    while done < found:
        outcome = first[order[done]]
        while outcome >= 0:
            state = outcome // n_each
            if steps[state] < 0:
                steps[state] = steps[order[done]] + 1
                order[found] = state
                found += 1
            outcome = following[outcome]
        done += 1
    return found


# The chain of a policy.

LARGEST_DENSE = 300


@dataclass(frozen=True, eq=False)
class PolicyChain:
    """The outcomes that happen under a stationary policy, one entry each."""

    model: TransitionModel  # the decision process
    used: Bools  # the actions that the policy takes, bool of shape (S, A)
    # The states of the chain, shape (n,); ``row`` and ``following`` are indices into this array.
    states: Ints
    row: Ints  # the state of each outcome, shape (m,)
    weight: Floats  # its probability under the policy, shape (m,)
    following: Ints  # its next state, shape (m,); meaningless where it ends the episode
    outcome: Ints  # its flat index into the arrays of the model, shape (m,)

    @classmethod
    def build(
        cls, model: TransitionModel, policy: Floats, states: Bools | None = None
    ) -> PolicyChain:
        """The chain of a policy matrix (S, A), on the states it visits or on those given.

        ``states``, bool of shape (S,), must be closed under the policy.
        """
        if states is None:
            states = model.reached_by(policy > 0)
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
        """The value of each outcome's next state, shape (m,); zero after termination."""
        return np.where(self.terminated, 0.0, values[self.following])

    def spread(self, result: Floats, mean: Floats) -> Floats:
        """The variance (n,) of a result per outcome (m,) around its mean (n,)."""
        return self.mean((result - mean[self.row]) ** 2)

    def solve(
        self, right: Floats, discount: float, *, zero: Bools | None = None, transposed: bool = False
    ) -> Floats:
        """Solve (I - discount P) x = right, with P the probabilities of going on to each state.

        With a reward per step on the right, x is the expected sum until the episode ends; the
        transposed system, with the starting distribution, gives the expected visits.

        Args:
            right: shape (n,).
            discount: from 0 to 1; at 1, each recurrent class of the chain must end the episode
                or be in ``zero``.
            zero: states where x is zero, bool of shape (n,).
            transposed: solve the transposed system.
        """
        kept = np.ones(self.size, np.bool_) if zero is None else ~zero
        leads = ~self.terminated & kept[self.row] & kept[self.following]
        place = np.cumsum(kept) - 1
        row, following = place[self.row[leads]], place[self.following[leads]]
        if transposed:
            row, following = following, row
        result, weight, n = np.zeros(self.size), -discount * self.weight[leads], int(kept.sum())
        if n <= LARGEST_DENSE:
            matrix = np.eye(n)
            np.add.at(matrix, (row, following), weight)
            result[kept] = np.linalg.solve(matrix, right[kept])
            return result
        from scipy.sparse import csc_array, eye_array
        from scipy.sparse.linalg import splu

        system = eye_array(n, format="csc") + csc_array((weight, (row, following)), shape=(n, n))
        result[kept] = splu(system).solve(right[kept])
        return result
