"""A learnt model that knows what leads to a state, and which pairs are worth updating most.

Compiled functions. A pair is the number ``obs * A + action``. Pairs that lead to the same state are
a list, each with the one before and the one behind it; those that are worth updating are a binary
heap, each with its place in it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from agents.tabular.models.learnt_models import note_outcome
from machine_code.compiling import inlined
from mdp.array_types import Bools, Floats, Ints

NONE = -1


class SweepingModel(NamedTuple):
    """The last outcome of each pair, and the queue.

    Attributes:
        next_obs: this and the next two as in `LearntModel`, with K = 1.
        rewards: see there.
        terminated: see there.
        counts: see there.
        first_into: the first pair that leads to a state, or `NONE`, shape (S,).
        behind: the next one that leads where a pair leads, or `NONE`, shape (S * A,).
        before: the one before it, or `NONE`, shape (S * A,).
        queue: the heap, the most urgent pair first, shape (S * A,).
        n_queued: how many they are, shape (1,).
        place: where in the heap a pair is, or `NONE`, shape (S * A,).
        urgency: how urgent it is, shape (S * A,).
    """

    next_obs: Ints
    rewards: Floats
    terminated: Bools
    counts: Ints
    first_into: Ints
    behind: Ints
    before: Ints
    queue: Ints
    n_queued: Ints
    place: Ints
    urgency: Floats


@inlined
def remember_step(model: SweepingModel, env: Any) -> None:
    """Keep the environment's last step, and which state its pair leads to."""
    pair = env.obs * model.counts.shape[1] + env.action
    if model.counts[env.obs, env.action] > 0 and not model.terminated[env.obs, env.action, 0]:
        _unlink(model, pair, model.next_obs[env.obs, env.action, 0])
    note_outcome(model, env)
    # Nothing follows from the end of an episode, so that nothing changes there.
    if not env.terminated:
        _link(model, pair, env.next_obs)


@inlined
def _link(model: SweepingModel, pair: int, obs: int) -> None:
    """Put a pair first among those that lead to a state."""
    first = model.first_into[obs]
    model.before[pair] = NONE
    model.behind[pair] = first
    if first != NONE:
        model.before[first] = pair
    model.first_into[obs] = pair


@inlined
def _unlink(model: SweepingModel, pair: int, obs: int) -> None:
    before, behind = model.before[pair], model.behind[pair]
    if before == NONE:
        model.first_into[obs] = behind
    else:
        model.behind[before] = behind
    if behind != NONE:
        model.before[behind] = before


@inlined
def _put(model: SweepingModel, pair: int, place: int) -> None:
    model.queue[place] = pair
    model.place[pair] = place


@inlined
def enqueue(model: SweepingModel, pair: int, urgency: float) -> None:
    """Put a pair into the queue; one that is there already stays at least as urgent as it is."""
    place = model.place[pair]
    if place == NONE:
        place = model.n_queued[0]
        model.n_queued[0] += 1
    elif urgency <= model.urgency[pair]:
        return
    model.urgency[pair] = urgency
    while place > 0:
        above = (place - 1) // 2
        if model.urgency[model.queue[above]] >= urgency:
            break
        _put(model, model.queue[above], place)
        place = above
    _put(model, pair, place)


@inlined
def most_urgent(model: SweepingModel) -> int:
    """Take the most urgent pair out of the queue, which must not be empty."""
    first = model.queue[0]
    model.place[first] = NONE
    model.n_queued[0] -= 1
    n = model.n_queued[0]
    if n > 0:
        _sink(model, model.queue[n], n)
    return int(first)


@inlined
def _sink(model: SweepingModel, pair: int, n: int) -> None:
    """Put a pair where the first of a heap of ``n`` was, or below."""
    place = 0
    while 2 * place + 1 < n:
        below = 2 * place + 1
        if below + 1 < n and (
            model.urgency[model.queue[below + 1]] > model.urgency[model.queue[below]]
        ):
            below += 1
        if model.urgency[model.queue[below]] <= model.urgency[pair]:
            break
        _put(model, model.queue[below], place)
        place = below
    _put(model, pair, place)
