"""A finite Markov decision process as arrays.

The arrays have shape (S, A, K): S states, A actions, and K, the largest number of outcomes that
any state and action has. Outcome k of taking action a in state s happens with probability
``prob[s, a, k]``, leads to ``next_state[s, a, k]``, earns ``reward[s, a, k]`` and ends the episode
if ``terminated[s, a, k]``. Rows with fewer outcomes are padded with outcomes of probability zero.

Termination belongs to the transition, not to the state: the rows of a state that only terminating
transitions enter are never used.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Types of arrays; docstrings give the shapes.
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
# Integers of any width, such as the int32 that halves the size of a large map.
AnyInts = NDArray[np.integer]

# The arrays prob, next_state, terminated, and a reward, as compiled functions take them.
Dynamics = tuple[Floats, AnyInts, Bools, Floats]

PROBABILITY_TOLERANCE = 1e-9
SINGLE_PRECISION = 1e-6  # the error of sums of probabilities in single precision

Outcomes = Sequence[tuple[float, int, float, bool]]


@dataclass(frozen=True, eq=False)
class TransitionModel:
    """The dynamics, rewards and starting states of a finite Markov decision process.

    The arrays are converted to the types below, copied only if necessary, and made read-only.
    Outcomes keep their order, and equal ones are not merged: a simulator that samples an outcome
    by cumulative sum then picks the same one as the source.

    Args:
        prob: probabilities, float64 of shape (S, A, K), summing to one over K.
        next_state: indices of the states reached, int64 (or int32) of shape (S, A, K).
        reward: rewards, float64 of shape (S, A, K).
        terminated: whether the episode ends with the outcome, bool of shape (S, A, K).
        initial: probabilities of the starting states, float64 of shape (S,), summing to one.
        reward_variance: variances of random rewards, float64 of shape (S, A, K); ``reward`` holds
            their means, and rewards are independent of each other. None where the outcome
            determines the reward.

    Raises:
        ValueError: where the shapes disagree, a probability lies outside [0, 1], a row of
            probabilities does not sum to one within 1e-9, an index is out of range, a reward or
            variance is not finite, or a variance negative. The message names state and action.
    """

    prob: Floats
    next_state: AnyInts
    reward: Floats
    terminated: Bools
    initial: Floats
    reward_variance: Floats | None = None

    def __post_init__(self) -> None:
        index_type = np.int32 if np.asarray(self.next_state).dtype == np.int32 else np.int64
        types = (np.float64, index_type, np.float64, np.bool_, np.float64, np.float64)
        for name, dtype in zip((field.name for field in fields(self)), types, strict=True):
            if (given := getattr(self, name)) is not None:
                # A view, so that the caller's own array stays writable.
                view = np.ascontiguousarray(given, dtype).view()
                object.__setattr__(self, name, _read_only(view))
        self._check_shapes()
        self._check_outcomes()

    @classmethod
    def from_gymnasium(
        cls,
        P: Mapping[int, Mapping[int, Outcomes]],  # noqa: N803 (Gymnasium's own name)
        initial_state_distrib: ArrayLike,
    ) -> TransitionModel:
        """The model in the attributes ``P`` and ``initial_state_distrib`` of Gymnasium's toy_text.

        Args:
            P: ``P[state][action]`` is a list of (probability, next state, reward, terminated);
                states and actions are numbered from zero.
            initial_state_distrib: probabilities of the starting states, shape (S,).

        Raises:
            ValueError: as the constructor, and where states have different numbers of actions
                or an outcome does not have these four parts. Probabilities in single precision,
                which sum to one within 1e-6, are scaled.
        """
        n_states = len(P)
        if not isinstance(P.get(0), Mapping):
            first = next(iter(P.items()), "nothing")
            wanted = f"P must map states, the numbers 0 to {n_states - 1}, to mappings of actions"
            raise ValueError(f"{wanted}; it begins with {reprlib.repr(first)}")
        n_actions = len(P[0])
        rows = [_row(P, state, action) for state in range(n_states) for action in range(n_actions)]
        lengths = np.array([len(row) for row in rows])
        n_outcomes = int(lengths.max())
        filled = np.arange(n_outcomes) < lengths[:, None]
        flat = [outcome for row in rows for outcome in row]

        def column(position: int, dtype: type[Any]) -> NDArray[Any]:
            padded = np.zeros(filled.shape, dtype)
            padded[filled] = [outcome[position] for outcome in flat]
            return padded.reshape(n_states, n_actions, n_outcomes)

        prob = column(0, np.float64)
        total = prob.sum(axis=2, keepdims=True)
        if np.abs(total - 1).max() < SINGLE_PRECISION:  # an exact sum stays as it is
            prob /= total
        return cls(
            prob=prob,
            next_state=column(1, np.int64),
            reward=column(2, np.float64),
            terminated=column(3, np.bool_),
            initial=np.asarray(initial_state_distrib, np.float64),
        )

    @property
    def n_states(self) -> int:
        """S, the number of states, unreachable ones included."""
        return int(self.prob.shape[0])

    @property
    def n_actions(self) -> int:
        """A, the number of actions."""
        return int(self.prob.shape[1])

    @property
    def n_outcomes(self) -> int:
        """K, the largest number of outcomes of any state and action, padding included."""
        return int(self.prob.shape[2])

    @property
    def dynamics(self) -> Dynamics:
        """``prob``, ``next_state``, ``terminated`` and ``expected_reward``."""
        return self.prob, self.next_state, self.terminated, self.expected_reward

    @cached_property
    def expected_reward(self) -> Floats:
        """The mean reward of one step, shape (S, A)."""
        return _read_only(np.einsum("sak,sak->sa", self.prob, self.reward))

    @cached_property
    def goes_on(self) -> Bools:
        """The possible outcomes that do not end the episode, bool of shape (S, A, K)."""
        return _read_only((self.prob > 0) & ~self.terminated)

    def after(self, actions: Bools) -> Bools:
        """The states that actions, bool of shape (S, A), may lead to; bool of shape (S,)."""
        found = np.zeros(self.n_states, np.bool_)
        found[self.next_state[self.goes_on & actions[:, :, None]]] = True
        return found

    def action_values(self, later: Floats) -> Floats:
        """The undiscounted action values, shape (S, A), from the state values one step later."""
        following = np.where(self.goes_on, later[self.next_state], 0.0)
        values: Floats = self.expected_reward + np.einsum("sak,sak->sa", self.prob, following)
        return values

    @cached_property
    def reachable(self) -> Bools:
        """The states in which the agent may have to act, bool of shape (S,).

        These are the possible starting states and all states that transitions reach from them
        without ending the episode. The rows of all other states are meaningless.
        """
        return _read_only(self.reached_by(np.ones(self.prob.shape[:2], np.bool_)))

    def reached_by(self, allowed: Bools) -> Bools:
        """The states that ``allowed`` actions, bool of shape (S, A), visit; bool of shape (S,)."""
        leads = self.goes_on & allowed[:, :, None]
        found = self.initial > 0
        new = np.flatnonzero(found)
        while len(new):
            reached = self.next_state[new][leads[new]]
            new = np.unique(reached[~found[reached]])
            found[new] = True
        return found

    def allowed_actions(self, mask: Bools | None = None) -> Bools:
        """The actions that planning may take, bool of shape (S, A); none in unreachable states.

        Args:
            mask: bool of shape (S, A), or None for all actions.

        Raises:
            ValueError: if the mask allows nothing in a reachable state.
        """
        reachable = self.reachable[:, None]
        if mask is None:
            return np.repeat(reachable, self.n_actions, axis=1)
        stuck = np.flatnonzero(self.reachable & ~mask.any(axis=1))
        if stuck.size:
            raise ValueError(f"the mask allows nothing in state {stuck[0]}")
        return reachable & mask.astype(np.bool_)

    def _check_shapes(self) -> None:
        shape = self.prob.shape
        if len(shape) != 3 or 0 in shape:
            raise ValueError(f"prob has shape {shape}, it must be (states, actions, outcomes)")
        for name in ("next_state", "reward", "terminated", "reward_variance"):
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, prob has {shape}")
        if self.initial.shape != shape[:1]:
            raise ValueError(f"initial has shape {self.initial.shape}, it must be {shape[:1]}")

    def _check_outcomes(self) -> None:
        # Written so that a NaN fails each check.
        self._require((self.prob >= 0) & (self.prob <= 1), "a probability outside [0, 1]")
        is_sum = np.abs(self.prob.sum(axis=2) - 1) <= PROBABILITY_TOLERANCE
        self._require(is_sum, "probabilities that do not sum to one")
        in_range = (self.next_state >= 0) & (self.next_state < self.n_states)
        self._require(in_range, f"a next state outside 0..{self.n_states - 1}")
        self._require(np.isfinite(self.reward), "a reward that is not finite")
        if self.reward_variance is not None:
            valid = np.isfinite(self.reward_variance) & (self.reward_variance >= 0)
            self._require(valid, "a variance of the reward that is negative or not finite")
        total = self.initial.sum()
        if not (abs(total - 1) <= PROBABILITY_TOLERANCE and (self.initial >= 0).all()):
            raise ValueError(f"initial holds no probabilities that sum to one: {self.initial}")

    @staticmethod
    def _require(valid: Bools, problem: str) -> None:
        if not valid.all():
            state, action = np.argwhere(~valid)[0][:2]
            raise ValueError(f"state {state}, action {action} has {problem}")


def _row(P: Mapping[int, Mapping[int, Outcomes]], state: int, action: int) -> Outcomes:  # noqa: N803
    if state not in P:
        raise ValueError(f"P has no state {state}: states must be numbered from 0 to {len(P) - 1}")
    if len(P[state]) != len(P[0]) or action not in P[state]:
        raise ValueError(f"state {state} must have the actions 0 to {len(P[0]) - 1} in P")
    if not P[state][action]:
        raise ValueError(f"state {state}, action {action} has no outcome in P")
    outcomes: Any = P[state][action]
    for outcome in outcomes:
        if len(outcome) != 4:
            form = "(probability, next state, reward, terminated)"
            found = f"an outcome is {form}, not {reprlib.repr(outcome)}"
            raise ValueError(f"state {state}, action {action}: {found}")
    return P[state][action]


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.setflags(write=False)
    return array
