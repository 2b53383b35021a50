"""Choosing and learning among the arms that the environment allows.

A rule is handed a smaller bandit: a copy of what the agent knows of the allowed arms in the present
context, and of no others. So no rule needs a line for masks, and where all arms are allowed it does
the same to the bit. Agents that do not go by masks never come here.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.bandits.linear_agent import LinearAgent, bonus, pick, predicted_mean
from agents.bandits.score_agent import (
    ScoreAgent,
    ScoreTables,
    choice_probability,
    choose_arm,
    learn,
)
from agents.compiled.generators import generator_of
from machine_code.compiling import inlined, kernel
from mdp.array_types import Bools, Floats, Ints


class AllowedTables(NamedTuple):
    """What an agent knows of the allowed arms in one context; arrays of shape (1, n).

    Attributes:
        scores: as in `ScoreTables`.
        sums: as in `ScoreTables`.
        counts: as in `ScoreTables`.
        other_count: number of the rewards of the other arms.
        other_sum: their sum.
    """

    scores: Floats
    sums: Floats
    counts: Ints
    other_count: int
    other_sum: float

    @inlined
    def masked_count(self) -> int:
        """Rewards of the masked arms."""
        return self.other_count

    @inlined
    def masked_sum(self) -> float:
        """Their sum."""
        return self.other_sum


class AllowedRoom(NamedTuple):
    """Where a smaller bandit is put together.

    Attributes:
        scores: shape (1, arms).
        sums: shape (1, arms).
        counts: shape (1, arms).
        arms: which arm is the smaller bandit's k-th, shape (arms,).
    """

    scores: Floats
    sums: Floats
    counts: Ints
    arms: Ints


def allowed_room(n_arms: int) -> AllowedRoom:
    """Room for bandits of up to ``n_arms``."""
    shape, whole = (1, n_arms), np.int64
    return AllowedRoom(
        np.empty(shape), np.empty(shape), np.empty(shape, whole), np.empty(n_arms, whole)
    )


@inlined
def allowed_tables(tables: ScoreTables, row: int, mask: Bools, room: AllowedRoom) -> AllowedTables:
    """What is known of the arms of ``mask`` in the context ``row``, copied."""
    n, other_count, other_sum = 0, 0, 0.0
    for arm in range(len(mask)):
        if mask[arm]:
            room.arms[n] = arm
            room.scores[0, n] = tables.scores[row, arm]
            room.sums[0, n] = tables.sums[row, arm]
            room.counts[0, n] = tables.counts[row, arm]
            n += 1
        else:
            other_count += tables.counts[row, arm]
            other_sum += tables.sums[row, arm]
    scores, sums, counts = room.scores[:, :n], room.sums[:, :n], room.counts[:, :n]
    return AllowedTables(scores, sums, counts, other_count, other_sum)


@kernel
def choose_allowed_arms(
    agent: ScoreAgent,
    rows: Ints,
    masks: Bools,
    room: AllowedRoom,
    progress: Any,
    arms: Ints,
    probabilities: Floats,
) -> int:
    """As `choose_arms`, among the arms in ``masks``, of shape (n, arms)."""
    for i in range(len(rows)):
        if not 0 <= rows[i] < agent.tables.scores.shape[0]:
            return i
        known = allowed_tables(agent.tables, rows[i], masks[i], room)
        numbers = agent.arms[: known.scores.shape[1]]
        smaller = ScoreAgent(agent.settings, known, agent.feedback, numbers, agent.draws, agent.rng)
        chosen = choose_arm(smaller, 0, progress)
        arms[i] = room.arms[chosen]
        probabilities[i] = choice_probability(smaller, 0, chosen)
    return -1


@kernel
def learn_one_allowed(
    agent: ScoreAgent, pull: Any, mask: Bools, room: AllowedRoom, progress: Any
) -> None:
    """As `learn_one`, of a pull at which the arms in ``mask`` were allowed, of shape (arms,)."""
    tables, row = agent.tables, pull.row
    known, place = allowed_tables(tables, row, mask, room), 0
    n = known.scores.shape[1]
    smaller = ScoreAgent(
        agent.settings, known, agent.feedback, agent.arms[:n], agent.draws, agent.rng
    )
    for k in range(n):
        if room.arms[k] == pull.arm:
            place = k
    pull.row = 0
    pull.arm = place
    learn(smaller, pull, progress)
    for k in range(n):
        arm = room.arms[k]
        tables.scores[row, arm] = room.scores[0, k]
        tables.sums[row, arm] = room.sums[0, k]
        tables.counts[row, arm] = room.counts[0, k]


@inlined
def choose_allowed_by_model(agent: LinearAgent, context: Floats, arms: Ints, progress: Any) -> int:
    """One of ``arms`` in ``context``; each has a model of its own, so that nothing is copied."""
    smaller = LinearAgent(
        agent.settings,
        agent.models,
        agent.feedback,
        agent.contexts,
        agent.context,
        agent.arms[: len(arms)],
        agent.features,
        agent.draws,
        agent.rng,
    )
    for k in range(len(arms)):
        smaller.arms[k] = predicted_mean(agent.models, arms[k], context)
        smaller.arms[k] += bonus(agent, arms[k], context)
    agent.draws[0] = generator_of(agent.rng).random()
    return int(arms[pick(smaller, progress)])


@kernel
def choose_all_allowed_by_model(
    agent: LinearAgent, contexts: Floats, masks: Bools, room: Ints, progress: Any, arms: Ints
) -> None:
    """As `choose_all_by_model`, among the arms in ``masks``, of shape (n, arms)."""
    for i in range(len(contexts)):
        n = 0
        for arm in range(masks.shape[1]):
            if masks[i, arm]:
                room[n] = arm
                n += 1
        arms[i] = choose_allowed_by_model(agent, contexts[i], room[:n], progress)
