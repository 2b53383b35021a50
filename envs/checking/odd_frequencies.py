"""Counts that the right probabilities would not have led to, as lines that people read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from envs.checking.watched_env import Steps, WatchedEnv, outcome_text, row_text
from mdp.array_types import Floats, Ints
from mdp.frequency_evidence import Frequencies, frequencies

# The chance that counts of a right model are called odd: over all that is looked at.
FALSE_ALARMS = 1e-6
N_FAMILIES = 8
# The first step, the next two, the next four, ...
N_BUCKETS = 40
# Starts by the start before them are counted for so many starting states at most.
MAX_STARTS = 200


class Family(NamedTuple):
    """Draws in groups, each with probabilities of its own.

    Attributes:
        groups: the group of each draw, from 0 on, shape (n,).
        outcomes: what was drawn, shape (n,).
        probabilities: of the outcomes, shape (H, K).
        n_alike: groups that share one row of them.
        n_tests: all groups and outcomes that could be looked at, whether they came up or not.
    """

    groups: Ints
    outcomes: Ints
    probabilities: Floats
    n_alike: int
    n_tests: int


class Odd(NamedTuple):
    """The oddest count of a family: of which outcome, in which group, how often, of how many."""

    group: int
    outcome: int
    times: int
    trials: int


def odd_frequencies(watched: WatchedEnv) -> Iterator[str]:
    """What an environment did too often or too seldom, one line each.

    Under the right probabilities there is a line with a chance of at most `FALSE_ALARMS`, however
    the steps were chosen: see `mdp.frequency_evidence`.
    """
    yield from _odd_starts(watched)
    steps, classes = watched.steps, watched.classes
    rows, places = steps.row, classes.place[steps.outcome]
    odd = _oddest(Family(rows, places, classes.row_prob, 1, len(classes.row)))
    if odd is not None:
        yield _line(watched, odd.group, odd, "")
    for context, size, text in _contexts(watched, steps):
        groups = classes.pattern[rows] * size + context
        n_tests = size * int(np.count_nonzero(classes.pattern_prob))
        odd = _oddest(Family(groups, places, classes.pattern_prob, size, n_tests))
        if odd is not None:
            row = int(rows[np.argmax(groups == odd.group)])
            where = f", counted over all that P gives these probabilities{text(odd.group % size)}"
            yield _line(watched, row, odd, where)


def _contexts(
    watched: WatchedEnv, steps: Steps
) -> Iterator[tuple[Ints, int, Callable[[int], str]]]:
    """What nothing may depend on: its value at each step, how many there are, and in words."""
    n_places, n_actions = watched.classes.row_prob.shape[1], watched.claim.model.n_actions
    yield 0 * steps.row, 1, lambda _: ""
    yield _bucket(steps.time), N_BUCKETS, lambda b: f" in {_steps_text(b)} of episodes"
    all_steps = np.arange(len(steps.row))
    yield _bucket(all_steps), N_BUCKETS, lambda b: f" in {_steps_text(b)} of the check"
    first = " at the beginning of episodes"
    yield (
        steps.before,
        n_places + 1,
        lambda p: f" where the last outcome was number {p} of P's" if p else first,
    )
    yield (
        steps.action_before,
        n_actions + 1,
        lambda a: f" right after action {a - 1}" if a else first,
    )


def _odd_starts(watched: WatchedEnv) -> Iterator[str]:
    initial = watched.claim.model.initial
    possible = np.flatnonzero(initial)
    starts = np.searchsorted(possible, [state for state, _ in watched.starts])
    n, prob = len(possible), initial[possible][None]
    families = [(Family(0 * starts, starts, prob, 1, n), "")]
    if n <= MAX_STARTS:
        by_last = Family(starts[:-1], starts[1:], prob, n, n * n)
        families.append((by_last, " where the episode before had begun in state {}"))
    for family, text in families:
        odd = _oddest(family)
        if odd is not None:
            yield (
                f"initial_state_distrib says state {possible[odd.outcome]} in "
                f"{prob[0, odd.outcome]:.1%} of cases, reset gave it in "
                f"{odd.times / odd.trials:.1%} of {odd.trials:,}"
                f"{text.format(possible[odd.group])}"
            )


def _oddest(family: Family) -> Odd | None:
    """The count that speaks most against its probability, if that is beyond chance."""
    if not len(family.groups):
        return None
    found: Frequencies = frequencies(
        family.groups, family.outcomes, family.probabilities, family.n_alike
    )
    group, outcome = np.unravel_index(np.argmax(found.evidence), found.evidence.shape)
    if found.evidence[group, outcome] < math.log(N_FAMILIES * family.n_tests / FALSE_ALARMS):
        return None
    counts = found.counts[group]
    return Odd(int(found.groups[group]), int(outcome), int(counts[outcome]), int(counts.sum()))


def _line(watched: WatchedEnv, row: int, odd: Odd, where: str) -> str:
    classes = watched.classes
    first = int(np.searchsorted(classes.row, row))
    outcome = list(classes.ids)[first + odd.outcome]
    return (
        f"{row_text(row, watched.claim.model.n_actions)}: P says {outcome_text(outcome)} in "
        f"{classes.row_prob[row, odd.outcome]:.1%} of cases, step gave it in "
        f"{odd.times / odd.trials:.1%} of {odd.trials:,}{where}"
    )


def _bucket(numbers: Ints) -> Ints:
    return np.log2(numbers + 1).astype(np.int64)


def _steps_text(bucket: int) -> str:
    return f"steps {2**bucket:,} to {2 ** (bucket + 1) - 1:,}"
