"""What value iteration and policy iteration share: where to plan, from where, how exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mdp.array_types import AnyInts, Bools, Floats, Ints
from mdp.graph import steps_to_end
from mdp.sweeps import action_values, evaluate, first_guess, policy_rows, residuals
from mdp.transition_model import TransitionModel
from mdp.undiscounted import FinitePart, finite_part

EPSILON = float(np.finfo(np.float64).eps)
# Where less of the probability than this is settled, relaxing by its inverse overshoots.
LEAST_SETTLED = 0.8
SWEEPS_PER_EVALUATION = 30
# Plenty for any chain that mixes at all; a bound that needs more is not worth waiting for.
MOST_EVALUATIONS = 10_000
# Of a linear system that is solved between two sweeps: the next policy asks for another one.
ACCURACY_OF_SOLUTIONS = 1e-2
MOST_KRYLOV_STEPS = 100


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """A decision process, a discount, and the part of it where the optimum is finite."""

    model: TransitionModel
    discount: float
    part: FinitePart

    @classmethod
    def of(
        cls, model: TransitionModel, discount: float, mask: Bools | None = None
    ) -> PlanningProblem:
        """Check the discount, and that the optimum is finite.

        Args:
            model: the decision process.
            discount: from 0 to 1.
            mask: the actions that may be taken, bool of shape (S, A), or None for all.

        Raises:
            ValueError: if the discount is not in [0, 1], the mask malformed, or the undiscounted
                optimum not finite.
        """
        if not 0 <= discount <= 1:
            raise ValueError(f"discount is {discount}, it must lie between 0 and 1")
        part = finite_part(model, mask) if discount == 1 else FinitePart.everything(model, mask)
        return cls(model, float(discount), part)

    @cached_property
    def order(self) -> Ints:
        """The states to plan for, those nearest to the end (or to rest) first."""
        steps, order = steps_to_end(self.model, self.part.allowed, self.part.resting)
        return np.concatenate([order, np.flatnonzero(self.part.states & (steps < 0))])

    @property
    def rows(self) -> tuple[Floats, AnyInts, Bools, Floats]:
        """The arrays of the model as the sweeps take them."""
        model = self.model
        return model.prob, model.next_state, model.terminated, model.expected_reward

    def start(self) -> tuple[Floats, Ints]:
        """First values, shape (S,), and a policy, shape (S,), that surely ends or comes to rest.

        Where rest is possible these are the policy's own values: from below, sweeps converge to
        the optimum, from above they may hold on to a reward that staying never collects.
        """
        part = self.part
        values = np.zeros(self.model.n_states)
        policy = part.rest_actions.argmax(axis=1)
        order = self.order[~part.resting[self.order]]
        known = part.resting.copy()
        first_guess(*self.rows, part.allowed, self.discount, known, order, values, policy)
        if part.resting.any():
            reward = self.model.expected_reward
            for _ in range(MOST_EVALUATIONS):
                change = self.evaluate(reward, policy, order, values, 0.0)
                if change <= self.rounding(values):
                    break
        return values, policy

    def evaluate(
        self, reward: Floats, policy: Ints, order: Ints, values: Floats, enough: float
    ) -> float:
        """Improve the values of a policy, in place, by some sweeps over the states of ``order``.

        Args:
            reward: mean rewards, shape (S, A).
            policy: actions, shape (S,).
            order: the states to sweep; all others count as ends.
            values: shape (S,).
            enough: the change of values at which to stop.

        Returns:
            The largest change of the last sweep.
        """
        model = self.model
        arrays = (model.prob, model.next_state, model.terminated, reward)
        rows = policy_rows(*arrays, self.discount, order, policy)
        settled = rows[3]
        settled[settled < LEAST_SETTLED] = 1.0
        found = values[order]
        first = latest = evaluate(*rows, found)
        for _ in range(SWEEPS_PER_EVALUATION - 1):
            if latest <= enough:
                break
            latest = evaluate(*rows, found)
        if latest <= first:
            values[order] = found
        return latest

    def solve(self, policy: Ints, order: Ints, values: Floats) -> None:
        """Improve the values of a policy, in place, where ``evaluate`` would need many sweeps.

        The linear system is solved by BiCGSTAB (van der Vorst, 1992), with a sweep as
        preconditioner, to a hundredth of what was missing. Needs a discount below one.

        Args:
            policy: actions, shape (S,).
            order: the states, all of those to plan for.
            values: shape (S,); as they were where the solution is not nearer.
        """
        from scipy.sparse.linalg import LinearOperator, bicgstab

        weight, following, reward, _ = policy_rows(*self.rows, self.discount, order, policy)
        n = len(order)
        stays = following == np.arange(n)[:, None]
        diagonal = 1.0 - np.where(stays, weight, 0.0).sum(axis=1)
        nothing = np.zeros(n)

        def product(vector: Floats) -> Floats:
            return -residuals(weight, following, nothing, vector)

        def sweep(right: Floats) -> Floats:
            found = np.zeros(n)
            evaluate(weight, following, right, diagonal, found)
            return found

        missing = residuals(weight, following, reward, values[order])
        change, _ = bicgstab(
            LinearOperator((n, n), product, dtype=np.float64),
            missing,
            rtol=ACCURACY_OF_SOLUTIONS,
            maxiter=MOST_KRYLOV_STEPS,
            M=LinearOperator((n, n), sweep, dtype=np.float64),
        )
        found = values[order] + change
        if np.abs(residuals(weight, following, reward, found)).max() <= np.abs(missing).max():
            values[order] = found

    def action_values(self, values: Floats) -> Floats:
        """Values of shape (S, A), minus infinity for actions that are not allowed."""
        return action_values(*self.rows, self.part.allowed, self.discount, values)

    def rounding(self, values: Floats) -> float:
        """The change of a value that rounding alone may make in one sweep."""
        return 8 * EPSILON * max(1.0, float(np.abs(values[self.order]).max(initial=0.0)))

    def error_bound(self, values: Floats, change: float) -> float:
        """How far values are from the optimum that a sweep has changed by at most ``change``.

        With discount, the operator is a contraction. Without, let each step that cannot end the
        episode cost at least c, and let M be so large that each step that may end it with
        probability p earns at most M p - c. Then (1 - e) values + e M is not raised by the
        operator, and (1 + e) values - e M not lowered, for e = change / (c - change): the
        optimum lies between. Where a step may cost nothing, no bound is known.
        """
        change += self.rounding(values)
        if self.discount < 1:
            return change / (1 - self.discount)
        cost = self.part.step_cost
        if cost <= change:
            return np.inf
        return change / (cost - change) * float(np.abs(self._ceiling - values[self.order]).max())

    @cached_property
    def _ceiling(self) -> float:
        """M of the error bound."""
        model = self.model
        ending = np.einsum("sak,sak->sa", model.prob, model.terminated)
        ends = self.part.allowed & (ending > 0)
        needed = (model.expected_reward[ends] + self.part.step_cost) / ending[ends]
        return float(needed.max(initial=0.0))

    def longest_episode(self, policy: Ints, rests: Bools) -> float:
        """The largest expected number of steps until a policy ends the episode or rests."""
        order = self.order[~rests[self.order]]
        steps = np.zeros(self.model.n_states)
        one = np.ones_like(self.model.expected_reward)
        for _ in range(MOST_EVALUATIONS):
            if self.evaluate(one, policy, order, steps, 0.0) <= 1e-6 * steps.max():
                return float(steps.max())
        return np.inf
