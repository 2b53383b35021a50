"""Agents that keep a score for each arm in each context: choosing an arm, learning from its reward.

Compiled functions, shared by the interpreted and the compiled loop. What an algorithm adds is
`choose_arm` and `learn_from_pull`, and `choice_probability` where its update asks for it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.compiled.dispatch import CompiledOnlyError, by_type
from machine_code.compiling import inlined, kernel
from mdp.array_types import Floats, Ints

# A pull and its reward, kept until the feedback is due.
PULL = np.dtype(
    [
        ("row", np.int64),  # the context
        ("arm", np.int64),
        ("reward", np.float64),
        ("probability", np.float64),  # how likely the choice was, where the update asks for it
    ],
    align=True,
)


@by_type
def masked_count(tables: Any) -> int:
    """Number of the rewards of arms in the context that are left out of the tables."""
    raise CompiledOnlyError


@by_type
def masked_sum(tables: Any) -> float:
    """Sum of the rewards of arms in the context that are left out of the tables."""
    raise CompiledOnlyError


class ScoreTables(NamedTuple):
    """What an agent knows; each of shape (contexts, arms).

    Attributes:
        scores: what it judges arms by: a value, a posterior mean, a preference, a log-weight.
        sums: sum of the rewards.
        counts: number of the rewards.
    """

    scores: Floats
    sums: Floats
    counts: Ints

    @inlined
    def masked_count(self) -> int:
        """All arms are in the tables."""
        return 0

    @inlined
    def masked_sum(self) -> float:
        """All arms are in the tables."""
        return 0.0


class Feedback(NamedTuple):
    """Pulls that wait for their feedback.

    Attributes:
        pulls: room for them, records of type `PULL`, shape (capacity,).
        waiting: how many there are, shape (1,).
    """

    pulls: NDArray[Any]
    waiting: Ints


class ScoreAgent(NamedTuple):
    """An agent as compiled functions see it.

    Attributes:
        settings: a record of the type that its class has.
        tables: what it knows, `ScoreTables` or `AllowedTables`.
        feedback: pulls that are not learnt from yet.
        arms: room for a number for each arm, shape (arms,).
        draws: room for the random numbers of a choice, shape (2,).
        rng: a handle of its generator.
    """

    settings: Any
    tables: Any
    feedback: Feedback
    arms: Floats
    draws: Floats
    rng: Any


@by_type
def choose_arm(agent: ScoreAgent, row: int, progress: Any) -> int:
    """An arm in the context ``row``."""
    raise CompiledOnlyError


@by_type
def choice_probability(agent: ScoreAgent, row: int, arm: int) -> float:
    """How likely the choice of ``arm`` was."""
    raise CompiledOnlyError


@by_type
def learn_from_pull(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Learn from a record of type `PULL`, whose reward is counted in already."""


@by_type
def before_counting(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Learn what has to be learnt before the reward is counted in."""


@inlined
def no_probability(agent: ScoreAgent, row: int, arm: int) -> float:
    """The update does not ask for it."""
    return 1.0


@inlined
def nothing_before(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """The update needs the reward counted in."""


@inlined
def total_count(tables: Any, row: int) -> int:
    """Rewards seen in a context, those of masked arms among them."""
    total = masked_count(tables)
    for arm in range(tables.counts.shape[1]):
        total += tables.counts[row, arm]
    return total


@inlined
def mean_reward(tables: Any, row: int) -> float:
    """Average of all rewards seen in a context, at least one."""
    total = masked_sum(tables)
    for arm in range(tables.sums.shape[1]):
        total += tables.sums[row, arm]
    return total / total_count(tables, row)


@inlined
def learn(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Count a reward in, and learn from it."""
    before_counting(agent, pull, progress)
    agent.tables.counts[pull.row, pull.arm] += 1
    agent.tables.sums[pull.row, pull.arm] += pull.reward
    learn_from_pull(agent, pull, progress)


@inlined
def act_on_scores(agent: ScoreAgent, env: Any, progress: Any) -> None:
    """Pull an arm in the context that the environment shows."""
    row = 0 if agent.settings.ignore_context else env.obs
    env.action = choose_arm(agent, row, progress)
    env.probability = choice_probability(agent, row, env.action)


@inlined
def learn_from_feedback(agent: ScoreAgent, envs: Any, progress: Any) -> None:
    """Keep the pull; learn from all that wait where their feedback comes in."""
    feedback, env = agent.feedback, envs[0]
    pull = feedback.pulls[feedback.waiting[0]]
    pull.row = 0 if agent.settings.ignore_context else env.obs
    pull.arm = env.action
    pull.reward = env.reward
    pull.probability = env.probability
    feedback.waiting[0] += 1
    if env.feedback_due:
        for k in range(feedback.waiting[0]):
            learn(agent, feedback.pulls[k], progress)
        feedback.waiting[0] = 0
    env.obs = env.new_obs


@kernel
def choose_arms(
    agent: ScoreAgent, rows: Ints, progress: Any, arms: Ints, probabilities: Floats
) -> int:
    """Fill in an arm for each of the contexts ``rows``, and how likely it was; shapes (n,).

    Returns:
        -1, or the place of a context that has no row in the tables, before which it stops.
    """
    for i in range(len(rows)):
        if not 0 <= rows[i] < agent.tables.scores.shape[0]:
            return i
        arms[i] = choose_arm(agent, rows[i], progress)
        probabilities[i] = choice_probability(agent, rows[i], arms[i])
    return -1


@kernel
def learn_one(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """`learn`, for the interpreted loop."""
    learn(agent, pull, progress)
