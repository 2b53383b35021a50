"""Compiled functions that choose arms and learn from rewards: by scores and by linear models."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.agents.common.exploration import greedy_action
from rl_yardstick.agents.compiled.loop import by_type, by_type_or_this
from rl_yardstick.agents.compiled.references import generator_of
from rl_yardstick.machine_code.compiling import inlined, kernel
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# Agents that keep a score for each arm in each context: choosing an arm, learning from its reward.
#
# Compiled functions, shared by the interpreted and the compiled loop. An algorithm defines
# `choose_arm` and `learn_from_reward`, and `choice_probability` if its update needs it.

# A pull and its reward, kept until the feedback is due.
PULL = np.dtype(
    [
        ("row", np.int64),  # the context
        ("arm", np.int64),
        ("reward", np.float64),
        ("probability", np.float64),  # of the choice, if the update needs it
    ],
    align=True,
)


class ScoreTables(NamedTuple):
    """The knowledge of an agent; each array of shape (contexts, arms)."""

    scores: Floats  # values, posterior means, preferences or log-weights of the arms
    sums: Floats  # sum of the rewards
    counts: Ints  # number of the rewards
    other_count: int = 0  # number of the rewards of masked arms, which are not in the tables
    other_sum: float = 0.0  # their sum


class Feedback(NamedTuple):
    """Pulls that wait for their feedback."""

    pulls: NDArray[Any]  # buffer of records of type `PULL`, shape (capacity,)
    waiting: Ints  # the number of pulls in it, shape (1,)


class ScoreAgent(NamedTuple):
    """An agent for compiled functions."""

    settings: Any  # a record of its class's type
    tables: ScoreTables  # its knowledge
    feedback: Feedback  # pulls that wait for their feedback
    arms: Floats  # scratch: a number for each arm, shape (arms,)
    draws: Floats  # scratch: the random numbers of a choice, shape (2,)
    rng: Any  # a handle of its generator


@by_type
def context_row(agent: Any, env: Any) -> int:
    """The agent's row for the present context of the environment."""
    raise NotImplementedError


@by_type
def choose_arm(agent: Any, row: int, progress: Any) -> int:
    """An arm in the context ``row``."""
    raise NotImplementedError


@by_type_or_this
def choice_probability(agent: Any, row: int, arm: int) -> float:
    """The probability of choosing ``arm``, or 1 if the update does not need it."""
    return 1.0


@by_type
def learn_from_reward(agent: Any, pull: Any, progress: Any) -> None:
    """Learn from a record of type `PULL`."""


@by_type
def choose_allowed(
    agent: Any, row: int, mask: Bools, room: AllowedRoom, progress: Any
) -> tuple[int, float]:
    """One of the arms of ``mask`` in the context ``row``, and the probability of the choice."""
    raise NotImplementedError


@inlined
def total_count(tables: Any, row: int) -> int:
    """Number of rewards seen in a context, including those of masked arms."""
    total: int = tables.other_count
    for arm in range(tables.counts.shape[1]):
        total += tables.counts[row, arm]
    return total


@inlined
def mean_reward(tables: Any, row: int) -> float:
    """Average of all rewards seen in a context; there must be at least one."""
    total: float = tables.other_sum
    for arm in range(tables.sums.shape[1]):
        total += tables.sums[row, arm]
    mean: float = total / total_count(tables, row)
    return mean


@inlined
def row_of_scores(agent: ScoreAgent, env: Any) -> int:
    """Each context has a row; all have row 0 if contexts are ignored."""
    return 0 if agent.settings.ignore_context else int(env.obs)


@inlined
def count_reward(tables: ScoreTables, pull: Any) -> None:
    """Add the reward of a record of type `PULL` to the tables."""
    tables.counts[pull.row, pull.arm] += 1
    tables.sums[pull.row, pull.arm] += pull.reward


@inlined
def act_in_context(agent: Any, env: Any, progress: Any) -> None:
    """Pull an arm in the present context of the environment, and keep the pull."""
    pull = agent.feedback.pulls[agent.feedback.waiting[0]]
    pull.row = context_row(agent, env)
    env.action = choose_arm(agent, pull.row, progress)
    pull.arm = env.action
    pull.probability = choice_probability(agent, pull.row, env.action)


@inlined
def learn_from_feedback(agent: Any, envs: Any, progress: Any) -> None:
    """Keep the reward; when feedback is due, learn from all waiting pulls."""
    feedback, env = agent.feedback, envs[0]
    feedback.pulls[feedback.waiting[0]].reward = env.reward
    feedback.waiting[0] += 1
    if env.feedback_due:
        for k in range(feedback.waiting[0]):
            learn_from_reward(agent, feedback.pulls[k], progress)
        feedback.waiting[0] = 0
    env.obs = env.new_obs


@kernel
def choose_arms(
    agent: Any,
    rows: Ints,
    n_rows: int,
    progress: Any,
    arms: Ints,
    probabilities: Floats,
    masks: Bools,
    room: AllowedRoom,
) -> int:
    """Fill in an arm of those in ``masks`` for each of the contexts ``rows``, and its probability.

    Shapes are (n,), of ``masks`` (n, arms). Returns -1, or the index of the first context without a
    row, where it stops.
    """
    for i in range(len(rows)):
        if not 0 <= rows[i] < n_rows:
            return i
        arms[i], probabilities[i] = choose_allowed(agent, rows[i], masks[i], room, progress)
    return -1


# Scores of the arms that the environment allows.
#
# A rule gets a smaller bandit: a copy of the agent's knowledge of the allowed arms in the present
# context. So no rule needs code for masks, and if all arms are allowed the result is the same bit
# for bit. Only the interpreted loop uses this.


class AllowedRoom(NamedTuple):
    """Buffers for the smaller bandit."""

    scores: Floats  # shape (1, arms)
    sums: Floats  # shape (1, arms)
    counts: Ints  # shape (1, arms)
    arms: Ints  # which arm is the smaller bandit's k-th, shape (arms,)


def allowed_room(n_arms: int) -> AllowedRoom:
    """Buffers for smaller bandits of up to ``n_arms``."""
    shape, whole = (1, n_arms), np.int64
    return AllowedRoom(
        np.empty(shape), np.empty(shape), np.empty(shape, whole), np.empty(n_arms, whole)
    )


@inlined
def allowed_tables(tables: ScoreTables, row: int, mask: Bools, room: AllowedRoom) -> ScoreTables:
    """A copy of the knowledge of the arms of ``mask`` in the context ``row``."""
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
    return ScoreTables(scores, sums, counts, other_count, other_sum)


@inlined
def choose_by_allowed_scores(
    agent: ScoreAgent, row: int, mask: Bools, room: AllowedRoom, progress: Any
) -> tuple[int, float]:
    """The rule's choice in the smaller bandit, and its probability."""
    known = allowed_tables(agent.tables, row, mask, room)
    numbers = agent.arms[: known.scores.shape[1]]
    smaller = ScoreAgent(agent.settings, known, agent.feedback, numbers, agent.draws, agent.rng)
    chosen = choose_arm(smaller, 0, progress)
    return int(room.arms[chosen]), choice_probability(smaller, 0, chosen)


@kernel
def learn_one(agent: ScoreAgent, pull: Any, mask: Bools, room: AllowedRoom, progress: Any) -> None:
    """Learn from a pull at which the arms in ``mask`` were allowed, of shape (arms,)."""
    tables, row, place = agent.tables, pull.row, 0
    known = allowed_tables(tables, row, mask, room)
    n = known.scores.shape[1]
    numbers = agent.arms[:n]
    smaller = ScoreAgent(agent.settings, known, agent.feedback, numbers, agent.draws, agent.rng)
    for k in range(n):
        if room.arms[k] == pull.arm:
            place = k
    pull.row = 0
    pull.arm = place
    learn_from_reward(smaller, pull, progress)
    for k in range(n):
        arm = room.arms[k]
        tables.scores[row, arm] = room.scores[0, k]
        tables.sums[row, arm] = room.sums[0, k]
        tables.counts[row, arm] = room.counts[0, k]


# Agents with a linear model of each arm's reward in the context.
#
# Each arm's ridge regression keeps the matrix A = ridge I + sum x x' as its factors L D L'. A new
# context changes them by a rank-one update that keeps A positive definite (Gill, Golub, Murray and
# Saunders, 1974, method C1). An algorithm defines `bonus`, and `pick` if it does not take the best
# arm.


class Regressions(NamedTuple):
    """The knowledge of a linear agent."""

    factors: Floats  # D on the diagonal and L below it, shape (arms, features, features)
    moments: Floats  # sum of reward times context, shape (arms, features)
    coefficients: Floats  # of the regression, shape (arms, features)
    counts: Ints  # number of rewards, shape (arms,)


class LinearAgent(NamedTuple):
    """A linear agent for compiled functions."""

    settings: Any  # a record of its class's type
    models: Regressions  # its knowledge
    feedback: Feedback  # pulls that wait for their feedback
    contexts: Floats  # of these pulls, or of choices to make, shape (capacity, features)
    context: Floats  # the present one of the environment, shape (features,)
    numbers: Ints  # the model's index of the k-th arm, shape (arms,)
    arms: Floats  # scratch: a number for each arm, shape (arms,)
    features: Floats  # scratch: a number for each feature, shape (features,)
    draws: Floats  # scratch: the random numbers of a choice, shape (2,)
    rng: Any  # a handle of its generator


@by_type_or_this
def bonus(agent: LinearAgent, arm: int, context: Floats) -> float:
    """The bonus added to the predicted reward before the best arm is chosen."""
    return 0.0


@by_type_or_this
def pick(agent: LinearAgent, progress: Any) -> int:
    """An arm by the scores in ``agent.arms``: the best; the first draw breaks ties."""
    return greedy_action(agent.arms, agent.draws[0] * agent.settings.tie_scale)


@inlined
def predicted_mean(models: Regressions, arm: int, context: Floats) -> float:
    """Expected reward of ``arm`` in ``context``, of shape (features,)."""
    mean = 0.0
    for i in range(len(context)):
        mean += context[i] * models.coefficients[arm, i]
    return mean


@inlined
def deviation(agent: LinearAgent, arm: int, context: Floats) -> float:
    """The square root of x' A^-1 x."""
    factors, solved = agent.models.factors, agent.features
    variance = 0.0
    for i in range(len(context)):
        solved[i] = context[i]
        for j in range(i):
            solved[i] -= factors[arm, i, j] * solved[j]
        variance += solved[i] * solved[i] / factors[arm, i, i]
    return math.sqrt(variance)


@inlined
def choose_by_model(agent: LinearAgent, row: int, progress: Any) -> int:
    """An arm in the context ``row``."""
    context = agent.contexts[row]
    for k in range(len(agent.arms)):
        arm = agent.numbers[k]
        agent.arms[k] = predicted_mean(agent.models, arm, context)
        agent.arms[k] += bonus(agent, arm, context)
    agent.draws[0] = generator_of(agent.rng).random()
    return pick(agent, progress)


@inlined
def add_context(models: Regressions, arm: int, context: Floats, rest: Floats) -> None:
    """Update the factors to those of A + x x'; ``rest`` is scratch of shape (features,)."""
    factors = models.factors
    for i in range(len(context)):
        rest[i] = context[i]
    weight = 1.0
    for j in range(len(context)):
        pivot = rest[j]
        old = factors[arm, j, j]
        new = old + weight * pivot * pivot
        gain = weight * pivot / new
        weight *= old / new
        factors[arm, j, j] = new
        for i in range(j + 1, len(context)):
            rest[i] -= pivot * factors[arm, i, j]
            factors[arm, i, j] += gain * rest[i]


@inlined
def solve(models: Regressions, arm: int) -> None:
    """Set the coefficients to A^-1 times the moments."""
    factors, solution = models.factors, models.coefficients
    n_features = solution.shape[1]
    for i in range(n_features):
        solution[arm, i] = models.moments[arm, i]
        for j in range(i):
            solution[arm, i] -= factors[arm, i, j] * solution[arm, j]
    for i in range(n_features - 1, -1, -1):
        solution[arm, i] /= factors[arm, i, i]
        for j in range(i + 1, n_features):
            solution[arm, i] -= factors[arm, j, i] * solution[arm, j]


@inlined
def learn_by_model(agent: LinearAgent, pull: Any, progress: Any) -> None:
    """Learn from a record of type `PULL`."""
    models, context = agent.models, agent.contexts[pull.row]
    add_context(models, pull.arm, context, agent.features)
    for i in range(len(context)):
        models.moments[pull.arm, i] += pull.reward * context[i]
    models.counts[pull.arm] += 1
    solve(models, pull.arm)


@inlined
def row_of_vector(agent: LinearAgent, env: Any) -> int:
    """The row of a new pull; its context is copied there until its feedback comes in."""
    row = agent.feedback.waiting[0]
    for i in range(len(agent.context)):
        agent.contexts[row, i] = agent.context[i]
    return int(row)


@inlined
def choose_by_allowed_models(
    agent: LinearAgent, row: int, mask: Bools, room: AllowedRoom, progress: Any
) -> tuple[int, float]:
    """One of the arms of ``mask``, and 1; each arm has its own model, so nothing is copied."""
    n = 0
    for arm in range(len(mask)):
        if mask[arm]:
            room.arms[n] = arm
            n += 1
    smaller = LinearAgent(
        agent.settings,
        agent.models,
        agent.feedback,
        agent.contexts,
        agent.context,
        room.arms[:n],
        agent.arms[:n],
        agent.features,
        agent.draws,
        agent.rng,
    )
    return int(room.arms[choose_by_model(smaller, row, progress)]), 1.0


@kernel
def learn_one_by_model(agent: LinearAgent, pull: Any) -> None:
    """`learn_by_model`, for the interpreted loop."""
    learn_by_model(agent, pull, None)
