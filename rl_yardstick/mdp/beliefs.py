"""The optimum over policies with memory, where observations hide the state (POMDPs).

An agent that remembers all observations knows the probability of each state: its belief. The
optimum over beliefs is the optimum over all policies that depend on the history of observations
(Astrom, Optimal Control of Markov Processes with Incomplete State Information, 1965; Kaelbling,
Littman and Cassandra, Planning and Acting in Partially Observable Stochastic Domains, 1998). Within
a time limit, finitely many beliefs are reachable from the start. Where they are few enough,
finite-horizon planning over them is exact. Else the beliefs furthest from the start are not
expanded, and bounds on their values give bounds on the optimum:

- Upper: the fast informed bound (Hauskrecht, Value-Function Approximations for Partially Observable
  Markov Decision Processes, 2000), as if each state were revealed one step late.
- Lower: the best of a set of plans, which point-based value iteration (Pineau, Gordon and Thrun,
  2003) computes at a few beliefs for each number of steps left.

Rewards are not observed; the end of an episode is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

# Limits for a few seconds of planning: beliefs to expand if exact, and if not; size of arrays by
# class and observation; beliefs to compute plans for, and the random walks that find them.
MOST_BELIEFS, MOST_OF_MORE = 30_000, 1_000
MOST_NUMBERS = 4_000_000
MOST_POINTS, WALKS = 128, 32
# Beliefs that agree to this many decimal places are merged.
DIGITS = 12
# The ends of a bracket count as equal within this, relative to the return.
SAME = 1e-9


class Bracket(NamedTuple):
    """Bounds on an optimum; equal where the optimum is known."""

    lower: float  # some policy with memory returns this much
    upper: float  # no policy returns more


@dataclass(frozen=True, eq=False)
class HiddenModel:
    """A decision process split into hidden classes of states (C) and groups of observations (G).

    States with the same outcomes form one class, whatever the agent observes in them.
    """

    reward: Floats  # mean reward of an action in a class, shape (A, C)
    arrive: Floats  # probability to go on in class c' and observe g, shape (A, C, G, C)
    start: Floats  # probability to begin in class c and observe g, shape (G, C)

    @classmethod
    def of(cls, model: TransitionModel, groups: Ints) -> HiddenModel | None:
        """Split the states of a model into classes and groups; None if the arrays are too large."""
        states = np.flatnonzero(model.reachable)
        possible = model.prob[states] > 0
        going = possible & ~model.terminated[states]
        columns = (
            model.prob[states],
            np.where(going, model.next_state[states], -1),
            np.where(possible, model.reward[states], 0.0),
            going,
        )
        rows = np.hstack([column.reshape(len(states), -1) for column in columns]) + 0.0
        as_bytes = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
        _, first, classes = np.unique(as_bytes, return_index=True, return_inverse=True)
        _, numbers = np.unique(groups[states], return_inverse=True)
        n_classes, n_groups = len(first), int(numbers.max()) + 1
        shape = (model.n_actions, n_classes, n_groups, n_classes)
        if np.prod(shape) > MOST_NUMBERS:
            return None
        place = np.zeros(model.n_states, np.int64)
        place[states] = np.arange(len(states))
        classes, numbers = classes.reshape(-1), numbers.reshape(-1)
        arrive, start = np.zeros(shape), np.zeros((n_groups, n_classes))
        row, action, outcome = np.nonzero(going[first])
        state = states[first][row]
        following = place[model.next_state[state, action, outcome]]
        at = action, row, numbers[following], classes[following]
        np.add.at(arrive, at, model.prob[state, action, outcome])
        np.add.at(start, (numbers, classes), model.initial[states])
        return cls(model.expected_reward[states[first]].T.copy(), arrive, start)


def memory_optimum(model: TransitionModel, groups: Ints, horizon: int) -> Bracket | None:
    """The highest expected return of any policy that depends on the history of observations.

    Or bounds on it, where too many beliefs are reachable; None where there are too many states and
    observations for either. ``groups`` holds the index of each state's observation, from 0 on,
    shape (S,); ``horizon`` is the time limit in steps.
    """
    hidden = HiddenModel.of(model, groups)
    if hidden is None:
        return None
    tree = _Tree(hidden, horizon, MOST_BELIEFS)
    if tree.is_cut:
        tree = _Tree(hidden, horizon, MOST_OF_MORE)
    informed = _informed_bounds(hidden, horizon)
    points = _points(hidden, informed[-1], horizon) if tree.is_cut else None
    upper, lower = np.zeros(len(tree.beliefs)), np.zeros(len(tree.beliefs))
    plans = blind = np.zeros((model.n_actions, len(hidden.reward[0])))
    for bound in informed:
        better = () if points is None else (_improved(hidden, plans, points),)
        blind = hidden.reward + np.einsum("acgd,ad->ac", hidden.arrive, blind)
        plans = np.concatenate([blind, *better])
        upper, lower = tree.backed_up(upper, bound), tree.backed_up(lower, plans)
    least, most = (float(tree.weights @ values[: len(tree.weights)]) for values in (lower, upper))
    if most - least <= SAME * max(1.0, abs(most)):
        least = most
    return Bracket(least, most)


class _Tree:
    """The beliefs reachable from the start, each once, nearest first."""

    def __init__(self, hidden: HiddenModel, horizon: int, most: int) -> None:
        self.hidden = hidden
        self._known: dict[bytes, int] = {}
        self._found: list[Floats] = []
        self.weights = np.zeros(0)  # probabilities of the initial beliefs
        chances = hidden.start.sum(axis=1)
        for group in np.flatnonzero(chances > 0):
            place = self._place(hidden.start[group] / chances[group])
            self.weights = np.pad(self.weights, (0, max(place + 1 - len(self.weights), 0)))
            self.weights[place] += chances[group]
        self.n_followed = 0  # beliefs whose successors are known
        self.is_cut = False  # whether there are too many beliefs to expand all of them
        self._links: list[tuple[Ints, Ints, Floats]] = []
        self._grow(horizon, most)

    def _place(self, belief: Floats) -> int:
        key = (np.round(belief, DIGITS) + 0.0).tobytes()
        if key not in self._known:
            self._known[key] = len(self._found)
            self._found.append(belief)
        return self._known[key]

    def _grow(self, horizon: int, most: int) -> None:
        """Expand beliefs step by step, as long as there are not too many."""
        from scipy.sparse import csr_array

        n_actions, _, n_groups, n_classes = self.hidden.arrive.shape
        at_once = max(MOST_NUMBERS // (n_groups * n_classes), 1)
        for _ in range(horizon - 1):
            layer_end = len(self._found)
            while self.n_followed < layer_end and len(self._found) <= most:
                end = min(self.n_followed + at_once, layer_end)
                self._follow(self.n_followed, end)
                self.n_followed = end
            self.is_cut = self.n_followed < layer_end
            if self.is_cut or layer_end == len(self._found):
                break
        self.beliefs = np.array(self._found)
        rows, columns, chances = (
            np.concatenate([link[part] for link in self._links]) if self._links else np.zeros(0)
            for part in range(3)
        )
        shape = (self.n_followed * n_actions, len(self.beliefs))
        self._next = csr_array((chances, (rows.astype(np.int64), columns.astype(np.int64))), shape)
        self._reward = (self.beliefs @ self.hidden.reward.T)[: self.n_followed]

    def _follow(self, begin: int, end: int) -> None:
        beliefs = np.array(self._found[begin:end])
        n_actions, n_classes, n_groups, _ = self.hidden.arrive.shape
        for action in range(n_actions):
            flat = self.hidden.arrive[action].reshape(n_classes, -1)
            joint = (beliefs @ flat).reshape(len(beliefs), n_groups, n_classes)
            chances = joint.sum(axis=2)
            row, group = np.nonzero(chances > 0)
            chance = chances[row, group]
            places = [self._place(each) for each in joint[row, group] / chance[:, None]]
            link = (begin + row) * n_actions + action, np.array(places, np.int64), chance
            self._links.append(link)

    def backed_up(self, values: Floats, plans: Floats) -> Floats:
        """Values with one more step left; beliefs that are not expanded get the best plan's.

        Plans have shape (n, C): the return of each plan from each class, with these steps left.
        """
        following = (self._next @ values).reshape(self._reward.shape)
        tail = (self.beliefs[self.n_followed :] @ plans.T).max(axis=1)
        return np.concatenate([(self._reward + following).max(axis=1), tail])


def _informed_bounds(hidden: HiddenModel, horizon: int) -> list[Floats]:
    """The fast informed bound with 1, 2, ... steps left, each of shape (A, C)."""
    bounds: list[Floats] = []
    last = np.zeros_like(hidden.reward)
    flat = hidden.arrive.reshape(-1, hidden.arrive.shape[3])
    for _ in range(horizon):
        by_next = (flat @ last.T).reshape(*hidden.arrive.shape[:3], -1)
        last = hidden.reward + by_next.max(axis=3).sum(axis=2)
        bounds.append(last)
    return bounds


def _improved(hidden: HiddenModel, plans: Floats, points: Floats) -> Floats:
    """Point-based backup: for each point the best action, then the best plan per observation."""
    n_actions, n_classes, n_groups, _ = hidden.arrive.shape
    flat = hidden.arrive.reshape(-1, n_classes)
    ahead = (flat @ plans.T).reshape(n_actions, n_classes, n_groups, -1).transpose(0, 2, 3, 1)
    best = (ahead @ points.T).argmax(axis=2)  # (A, G, n)
    action, group = np.ogrid[:n_actions, :n_groups]
    chosen = ahead[action[..., None], group[..., None], best].sum(axis=1)  # (A, n, C)
    chosen += hidden.reward[:, None]
    first = np.einsum("anc,nc->na", chosen, points).argmax(axis=1)
    better: Floats = np.unique(chosen[first, np.arange(len(points))], axis=0)
    return better


def _points(hidden: HiddenModel, bound: Floats, horizon: int) -> Floats:
    """Beliefs met on random walks whose actions are greedy for the bound."""
    rng = np.random.default_rng(0)
    found: dict[bytes, Floats] = {}
    for _ in range(WALKS):
        joint = hidden.start
        for _ in range(horizon):
            chances = joint.sum(axis=1)
            if rng.random() >= chances.sum():
                break
            group = rng.choice(len(chances), p=chances / chances.sum())
            belief = joint[group] / chances[group]
            found[np.round(belief, DIGITS).tobytes()] = belief
            joint = np.einsum("c,cgd->gd", belief, hidden.arrive[(bound @ belief).argmax()])
    beliefs: Floats = np.array(list(found.values()))
    places = np.linspace(0, len(beliefs) - 1, min(len(beliefs), MOST_POINTS)).astype(np.int64)
    spread: Floats = beliefs[places]
    return spread
