"""The compiled loop: a whole run of an agent on a bandit in one call.

It does what the interpreted loop does, in the same order, with the same functions and the same
random numbers, so that both end in the same bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.bandits.choosing import choice_probability, choose_arm
from agents.bandits.learning import learn
from agents.bandits.linear_rules import (
    LinearSettings,
    Regressions,
    choose_linear_arm,
    learn_linear,
)
from agents.bandits.tables import Settings, Tables
from agents.bandits.worlds import World, expect, feedback_is_due, pull_arm
from agents.common.schedules import ScheduleRow, schedule_value
from mdp.machine_code import inlined, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Pulls(NamedTuple):
    """What happens at each pull; all of shape (pulls,), filled in by the loop."""

    arms: NDArray[np.int16]
    rewards: NDArray[np.float32]
    regrets: Floats
    contexts: NDArray[np.int32]


class Pending(NamedTuple):
    """Room for the pulls whose feedback is not due yet; shapes (batch size, ...)."""

    rows: Ints
    vectors: Floats
    arms: Ints
    rewards: Floats
    probabilities: Floats


class Scratch(NamedTuple):
    """Room for intermediate results."""

    expected: Floats
    scores: Floats
    draws: Floats
    features: Floats


class Moments(NamedTuple):
    """Tables kept at some moments.

    Attributes:
        pulls: after how many pulls, rising, shape (moments,).
        sums: filled in, shape (moments, contexts, arms).
        counts: filled in, likewise.
    """

    pulls: Ints
    sums: Floats
    counts: Ints


@inlined
def note(pulls: Pulls, t: int, row: int, arm: int, reward: float, regret: float) -> None:
    """Write down one pull."""
    pulls.contexts[t] = row
    pulls.arms[t] = arm
    pulls.rewards[t] = reward
    pulls.regrets[t] = regret


@inlined
def keep_moment(moments: Moments, moment: int, tables: Tables) -> None:
    """Write down the tables."""
    for row in range(tables.sums.shape[0]):
        for arm in range(tables.sums.shape[1]):
            moments.sums[moment, row, arm] = tables.sums[row, arm]
            moments.counts[moment, row, arm] = tables.counts[row, arm]


@kernel
def run_tables(
    world: World,
    settings: Settings,
    tables: Tables,
    ignore_context: bool,
    exploration: ScheduleRow,
    learning_rate: ScheduleRow,
    world_rng: np.random.Generator,
    rng: np.random.Generator,
    pulls: Pulls,
    pending: Pending,
    moments: Moments,
    scratch: Scratch,
) -> None:
    """A run of an agent with a score for each arm.

    Args:
        world: the bandit, changed in place.
        settings: the agent.
        tables: what it knows, changed in place.
        ignore_context: one row for all contexts.
        exploration: schedule of epsilon or of the temperature.
        learning_rate: schedule of the step size.
        world_rng: the environment's generator.
        rng: the agent's generator.
        pulls: filled in.
        pending: room.
        moments: filled in.
        scratch: room.
    """
    n_pulls = len(pulls.arms)
    remaining = 1.0
    waiting = 0
    moment = 0
    for t in range(n_pulls):
        context = world.row[0]
        row = 0 if ignore_context else context
        rate = schedule_value(exploration, remaining)
        best = expect(world, scratch.expected)
        arm = choose_arm(settings, tables, row, rate, rng, scratch.draws, scratch.scores)
        pending.rows[waiting] = row
        pending.arms[waiting] = arm
        pending.probabilities[waiting] = choice_probability(
            settings, tables, row, arm, scratch.scores
        )
        reward = pull_arm(world, arm, scratch.expected, world_rng)
        pending.rewards[waiting] = reward
        waiting += 1
        note(pulls, t, context, arm, reward, best - scratch.expected[arm])
        remaining = 1.0 - float(t + 1) / float(n_pulls)
        if feedback_is_due(world, t + 1):
            for k in range(waiting):
                learn(
                    settings,
                    tables,
                    pending.rows[k],
                    pending.arms[k],
                    pending.rewards[k],
                    pending.probabilities[k],
                    schedule_value(learning_rate, remaining),
                    scratch.scores,
                )
            waiting = 0
        if moment < len(moments.pulls) and t + 1 == moments.pulls[moment]:
            keep_moment(moments, moment, tables)
            moment += 1


@kernel
def run_regressions(
    world: World,
    settings: LinearSettings,
    models: Regressions,
    exploration: ScheduleRow,
    world_rng: np.random.Generator,
    rng: np.random.Generator,
    pulls: Pulls,
    pending: Pending,
    scratch: Scratch,
) -> None:
    """A run of an agent with a linear model for each arm; arguments as in `run_tables`."""
    n_pulls = len(pulls.arms)
    remaining = 1.0
    waiting = 0
    for t in range(n_pulls):
        context = world.row[0]
        for i in range(len(world.vector)):
            pending.vectors[waiting, i] = world.vector[i]
        rate = schedule_value(exploration, remaining)
        best = expect(world, scratch.expected)
        arm = choose_linear_arm(
            settings,
            models,
            world.vector,
            rate,
            rng,
            scratch.draws,
            scratch.scores,
            scratch.features,
        )
        reward = pull_arm(world, arm, scratch.expected, world_rng)
        pending.arms[waiting] = arm
        pending.rewards[waiting] = reward
        waiting += 1
        note(pulls, t, context, arm, reward, best - scratch.expected[arm])
        remaining = 1.0 - float(t + 1) / float(n_pulls)
        if feedback_is_due(world, t + 1):
            for k in range(waiting):
                learn_linear(
                    models,
                    pending.arms[k],
                    pending.vectors[k],
                    pending.rewards[k],
                    scratch.features,
                )
            waiting = 0
