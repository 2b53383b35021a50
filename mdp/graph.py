"""Which states lead where: reachability, distance to the end of an episode, end components.

Every function takes ``allowed``, bool of shape (S, A): the actions that count. Outcomes of
probability zero lead nowhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mdp.array_types import AnyInts, Bools, Floats, Ints
from mdp.machine_code import compiled
from mdp.reachability import reached_from
from mdp.transition_model import TransitionModel


def reachable_states(model: TransitionModel, allowed: Bools) -> Bools:
    """The states that are visited, with positive probability, by allowed actions.

    Returns:
        bool of shape (S,): starting states, and whatever non-terminating transitions reach.
    """
    start = model.initial > 0
    return reached_from(start, model.prob, model.next_state, model.terminated, allowed)


def steps_to_end(model: TransitionModel, allowed: Bools, target: Bools) -> tuple[Ints, Ints]:
    """The fewest transitions of positive probability to a termination or to a target state.

    Returns:
        The number of steps, shape (S,): 0 for target states, -1 where there is no way. And the
        states that have a way, in the order of that number.
    """
    ends = (model.terminated & (model.prob > 0) & allowed[:, :, None]).any(axis=(1, 2))
    steps = np.where(target, 0, np.where(ends, 1, -1))
    order = np.empty(model.n_states, np.int64)
    nearest = np.concatenate([np.flatnonzero(steps == 0), np.flatnonzero(steps == 1)])
    order[: len(nearest)] = nearest
    edges = (model.prob, model.next_state, model.terminated, allowed)
    first = _count_predecessors(*edges)
    predecessors = np.empty(first[-1], np.int32 if model.n_states < 2**31 else np.int64)
    _list_predecessors(*edges, first.copy(), predecessors)
    found = _search_backwards(first, predecessors, steps, order, len(nearest))
    return steps, order[:found]


def end_components(model: TransitionModel, allowed: Bools) -> tuple[Ints, Bools]:
    """The maximal sets of states in which an agent can stay for ever, surely.

    An end component is a set of states and actions such that no outcome ends the episode or
    leaves the set, and each state can be reached from each other (de Alfaro, Formal Verification
    of Probabilistic Systems, 1997, section 3.3).

    Returns:
        The number of each state's component, shape (S,), -1 for states in none; and the actions
        that stay within the component, bool of shape (S, A).
    """
    from scipy.sparse.csgraph import connected_components

    possible = model.prob > 0
    inside = allowed & ~(possible & model.terminated).any(axis=2)
    while True:
        _, label = connected_components(_graph(model, inside), connection="strong")
        same = label[model.next_state] == label[:, None, None]
        kept = inside & (same | ~possible).all(axis=2)
        if np.array_equal(kept, inside):
            return np.where(kept.any(axis=1), label, -1).astype(np.int64), kept
        inside = kept


def _graph(model: TransitionModel, allowed: Bools) -> Any:
    from scipy.sparse import csr_array

    edges = (model.prob > 0) & allowed[:, :, None]
    states = np.nonzero(edges)[0]
    ones = np.ones(len(states), np.int8)
    shape = (model.n_states, model.n_states)
    return csr_array((ones, (states, model.next_state[edges])), shape=shape)


@compiled
def _count_predecessors(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    allowed: Bools,
) -> Ints:
    """Where each state's list of predecessors begins; the last entry is the length of all."""
    n_states, n_actions, n_outcomes = prob.shape
    first = np.zeros(n_states + 1, np.int64)
    for state in range(n_states):
        for action in range(n_actions):
            if allowed[state, action]:
                for k in range(n_outcomes):
                    if prob[state, action, k] > 0 and not terminated[state, action, k]:
                        first[next_state[state, action, k] + 1] += 1
    for state in range(n_states):
        first[state + 1] += first[state]
    return first


@compiled
def _list_predecessors(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    allowed: Bools,
    place: Ints,
    predecessors: AnyInts,
) -> None:
    n_states, n_actions, n_outcomes = prob.shape
    for state in range(n_states):
        for action in range(n_actions):
            if allowed[state, action]:
                for k in range(n_outcomes):
                    if prob[state, action, k] > 0 and not terminated[state, action, k]:
                        reached = next_state[state, action, k]
                        predecessors[place[reached]] = state
                        place[reached] += 1


@compiled
def _search_backwards(
    first: Ints, predecessors: AnyInts, steps: Ints, order: Ints, found: int
) -> int:
    """Breadth-first search from the first ``found`` states in order; returns how many there are."""
    done = 0
    while done < found:
        reached = order[done]
        done += 1
        for place in range(first[reached], first[reached + 1]):
            state = predecessors[place]
            if steps[state] < 0:
                steps[state] = steps[reached] + 1
                order[found] = state
                found += 1
    return found
