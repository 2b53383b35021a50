"""Agents with a linear model of each arm's reward in the context.

Each arm's ridge regression keeps the matrix A = ridge I + sum x x' as its factors L D L', which a
new context changes by a rank-one update that cannot lose positive definiteness (Gill, Golub, Murray
and Saunders, 1974, method C1). Compiled functions, shared by both loops. What an algorithm adds is
`bonus`, and `pick` where it does not take the best.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from agents.bandits.score_agent import Feedback
from agents.common.exploration import greedy_action
from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.generators import generator_of
from machine_code.compiling import inlined, kernel
from mdp.array_types import Floats, Ints


class Regressions(NamedTuple):
    """What an agent knows.

    Attributes:
        factors: D on the diagonal and L below it, shape (arms, features, features).
        moments: sum of reward times context, shape (arms, features).
        coefficients: of the regression, shape (arms, features).
        counts: number of rewards, shape (arms,).
    """

    factors: Floats
    moments: Floats
    coefficients: Floats
    counts: Ints


class LinearAgent(NamedTuple):
    """An agent as compiled functions see it.

    Attributes:
        settings: a record of the type that its class has.
        models: what it knows.
        feedback: pulls that are not learnt from yet.
        contexts: of those pulls, shape (capacity, features).
        context: what an arm is to be chosen in, shape (features,).
        arms: room for a number for each arm, shape (arms,).
        features: room for a number for each feature, shape (features,).
        draws: room for the random numbers of a choice, shape (2,).
        rng: a handle of its generator.
    """

    settings: Any
    models: Regressions
    feedback: Feedback
    contexts: Floats
    context: Floats
    arms: Floats
    features: Floats
    draws: Floats
    rng: Any


@by_type
def bonus(agent: LinearAgent, arm: int, context: Floats) -> float:
    """What is added to the predicted reward before the best arm is taken."""
    raise CompiledOnlyError


@by_type
def pick(agent: LinearAgent, progress: Any) -> int:
    """An arm by the scores in ``agent.arms`` and the first draw in ``agent.draws``."""
    raise CompiledOnlyError


@inlined
def best_arm(agent: LinearAgent, progress: Any) -> int:
    """A best arm, whichever of several the draw falls on."""
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
def choose_by_model(agent: LinearAgent, context: Floats, progress: Any) -> int:
    """An arm in ``context``."""
    for arm in range(len(agent.arms)):
        agent.arms[arm] = predicted_mean(agent.models, arm, context)
        agent.arms[arm] += bonus(agent, arm, context)
    agent.draws[0] = generator_of(agent.rng).random()
    return pick(agent, progress)


@inlined
def add_context(models: Regressions, arm: int, context: Floats, rest: Floats) -> None:
    """Make the factors those of A + x x'; ``rest`` is room for a number for each feature."""
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
    """Make the coefficients those of A^-1 times the moments."""
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
def learn_by_model(agent: LinearAgent, pull: Any, context: Floats) -> None:
    """Learn from a record of type `PULL` in ``context``."""
    models = agent.models
    add_context(models, pull.arm, context, agent.features)
    for i in range(len(context)):
        models.moments[pull.arm, i] += pull.reward * context[i]
    models.counts[pull.arm] += 1
    solve(models, pull.arm)


@inlined
def act_on_context(agent: LinearAgent, env: Any, progress: Any) -> None:
    """Pull an arm in the context that the environment shows."""
    env.action = choose_by_model(agent, agent.context, progress)
    waiting = agent.feedback.waiting[0]
    # The environment moves on to another context before there is anything to learn from this one.
    for i in range(len(agent.context)):
        agent.contexts[waiting, i] = agent.context[i]


@inlined
def learn_from_contexts(agent: LinearAgent, envs: Any, progress: Any) -> None:
    """Keep the pull; learn from all that wait where their feedback comes in."""
    feedback, env = agent.feedback, envs[0]
    pull = feedback.pulls[feedback.waiting[0]]
    pull.arm = env.action
    pull.reward = env.reward
    feedback.waiting[0] += 1
    if env.feedback_due:
        for k in range(feedback.waiting[0]):
            learn_by_model(agent, feedback.pulls[k], agent.contexts[k])
        feedback.waiting[0] = 0
    env.obs = env.new_obs


@kernel
def choose_all_by_model(agent: LinearAgent, contexts: Floats, progress: Any, arms: Ints) -> None:
    """Fill in an arm for each of the contexts, which are of shape (n, features)."""
    for i in range(len(contexts)):
        arms[i] = choose_by_model(agent, contexts[i], progress)


@kernel
def learn_one_by_model(agent: LinearAgent, pull: Any, context: Floats) -> None:
    """`learn_by_model`, for the interpreted loop."""
    learn_by_model(agent, pull, context)
