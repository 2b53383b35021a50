"""What a policy is worth under a time limit, worked out in the way that takes least.

Where nothing is random, each state has one way, and ways are doubled. Elsewhere small problems are
worked out backwards from the limit, and large ones forwards from the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdp.array_types import Bools, Floats, Ints
from mdp.graph import reachable_states
from mdp.moments import moments_under_limit, visits_under_limit
from mdp.paths import moments_along_ways
from mdp.policies import Policy, actions_used, chances_in
from mdp.policy_returns import PolicyReturn, over_starts
from mdp.spreading import moments_by_spreading
from mdp.transition_model import TransitionModel

# Visited states times steps; beyond, going backwards takes longer than tenths of a second.
MOST_BACKWARDS = 2_000_000


@dataclass(frozen=True, eq=False)
class LimitedEpisodes:
    """The episodes of a policy under a time limit.

    Attributes:
        model: the decision process.
        policy: as `mdp.policies.canonical_policy` gives it.
        horizon: the time limit in steps.
    """

    model: TransitionModel
    policy: Policy
    horizon: int

    def result(
        self, discount: float, ends_well: Bools, *, with_success: bool, floor: float = -np.inf
    ) -> PolicyReturn:
        """Mean and variance of one episode.

        Args:
            discount: from 0 to 1.
            ends_well: the outcomes that count as success, bool of shape (S, A, K).
            with_success: whether success was defined.
            floor: a mean return that surely is below this may be told as minus infinity; only
                without discount.
        """
        states = self._visited()
        moments = self.along_ways(states, discount, ends_well)
        if moments is None and self._is_large(states):
            mean, variance, length, spread, rate = self._forwards(discount, ends_well, floor)
            return PolicyReturn(
                float(mean),
                float(variance),
                float(length),
                float(spread),
                float(rate) if with_success else None,
            )
        if moments is None:
            rows = (*self._rows(states), self.model.reward[states], ends_well[states])
            chances = chances_in(self.model, self.policy, states)
            if len(chances) == 1 and ((chances == 0) | (chances == 1)).all():
                # The rows of all other actions would only be passed over, again and again.
                taken = np.arange(len(states)), chances[0].argmax(axis=1)
                rows = tuple(array[taken][:, None] for array in rows)
                chances = np.ones((1, len(states), 1))
            moments = moments_under_limit(*rows, chances, self.horizon, discount)
        return over_starts(self.model.initial[states], moments, with_success=with_success)

    def visits(self) -> Floats:
        """The expected number of times that an episode acts in each state, shape (S,)."""
        states, visits = self._visited(), np.zeros(self.model.n_states)
        chances = chances_in(self.model, self.policy, states)
        start = self.model.initial[states]
        visits[states] = visits_under_limit(*self._rows(states), chances, start, self.horizon)
        return visits

    def _visited(self) -> Ints:
        return np.flatnonzero(reachable_states(self.model, actions_used(self.model, self.policy)))

    def _rows(self, states: Ints) -> tuple[Floats, Ints, Bools]:
        """Rows of the model for the n states alone: prob, next_state (counting in those n), ..."""
        model = self.model
        following = self._places(states)[model.next_state[states]]
        return model.prob[states], following, model.terminated[states]

    def _places(self, states: Ints) -> Ints:
        place = np.full(self.model.n_states, -1)
        place[states] = np.arange(len(states))
        return place

    def _is_stationary(self) -> bool:
        is_actions = np.issubdtype(self.policy.dtype, np.integer)
        return not is_actions or len(self.policy) == 1

    def _is_large(self, states: Ints) -> bool:
        return self._is_stationary() and len(states) * self.horizon > MOST_BACKWARDS

    def along_ways(self, states: Ints, discount: float, ends_well: Bools) -> Floats | None:
        """The moments where each of the states has one outcome; None where one has more.

        Args:
            states: those that count, of which none may lead to any other; n of them.
            discount: from 0 to 1.
            ends_well: the outcomes that count as success, bool of shape (S, A, K).

        Returns:
            Shape (n, 5), see `mdp.moments`.
        """
        if not self._is_stationary():
            return None
        if np.issubdtype(self.policy.dtype, np.integer):
            action = self.policy[0, states].astype(np.int64)
        else:
            action = self.policy[states].argmax(axis=1)
            if (self.policy[states, action] != 1).any():
                return None
        outcome = self.model.prob[states, action].argmax(axis=1)
        at = states, action, outcome
        if (self.model.prob[at] != 1).any():
            return None
        following = self._places(states)[self.model.next_state[at]]
        ends, reward = self.model.terminated[at], self.model.reward[at]
        return moments_along_ways(following, ends, reward, ends_well[at], self.horizon, discount)

    def _forwards(self, discount: float, ends_well: Bools, floor: float) -> Floats:
        """The moments (5,) of an episode from the distribution of the starting states."""
        model = self.model
        if np.issubdtype(self.policy.dtype, np.integer):
            chances = np.zeros((model.n_states, model.n_actions))
            chances[np.arange(model.n_states), np.clip(self.policy[0], 0, model.n_actions - 1)] = 1
        else:
            chances = np.asarray(self.policy, np.float64)
        rows = model.prob, model.next_state, model.terminated, model.reward, ends_well
        return moments_by_spreading(rows, chances, model.initial, self.horizon, discount, floor)
