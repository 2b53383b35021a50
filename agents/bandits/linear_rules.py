"""The rules of the agents with a linear model of each arm's reward in the context.

Each arm's ridge regression keeps the matrix A = ridge I + sum x x' as its factors L D L', which a
new context changes by a rank-one update that cannot lose positive definiteness (Gill, Golub, Murray
and Saunders, 1974, method C1). Pure compiled functions, shared by both loops.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.common.exploration import choose_action, greedy_action
from mdp.machine_code import inlined

LIN_UCB = 0
LIN_THOMPSON = 1
LIN_EPSILON_GREEDY = 2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class LinearSettings(NamedTuple):
    """How an agent chooses.

    Attributes:
        rule: which rule.
        strategy: exploration strategy of the agent that explores around its values.
        tie_scale: 1 to break ties at random, 0 to take the first best arm.
        alpha: how many standard deviations a bound lies above the mean, or a sample around it.
    """

    rule: int
    strategy: int
    tie_scale: float
    alpha: float


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


@inlined
def predicted_mean(models: Regressions, arm: int, context: Floats) -> float:
    """Expected reward of ``arm`` in ``context``, of shape (features,)."""
    mean = 0.0
    for i in range(len(context)):
        mean += context[i] * models.coefficients[arm, i]
    return mean


@inlined
def deviation(models: Regressions, arm: int, context: Floats, solved: Floats) -> float:
    """The square root of x' A^-1 x; ``solved`` is room for as many numbers as features."""
    variance = 0.0
    for i in range(len(context)):
        solved[i] = context[i]
        for j in range(i):
            solved[i] -= models.factors[arm, i, j] * solved[j]
        variance += solved[i] * solved[i] / models.factors[arm, i, i]
    return math.sqrt(variance)


@inlined
def choose_linear_arm(
    settings: LinearSettings,
    models: Regressions,
    context: Floats,
    rate: float,
    rng: np.random.Generator,
    draws: Floats,
    scratch: Floats,
    solved: Floats,
) -> int:
    """Choose an arm.

    LinUCB with disjoint models (Li et al., 2010); linear Thompson sampling (Agrawal and Goyal,
    2013), which scores one context, so that a normal number for each arm's mean reward does what a
    draw of all its coefficients would.

    Args:
        settings: the agent.
        models: what it knows.
        context: shape (features,).
        rate: epsilon.
        rng: the agent's generator.
        draws: room for 2 numbers.
        scratch: room for a number for each arm.
        solved: room for a number for each feature.
    """
    for arm in range(len(scratch)):
        scratch[arm] = predicted_mean(models, arm, context)
        if settings.rule == LIN_UCB:
            scratch[arm] += settings.alpha * deviation(models, arm, context, solved)
        elif settings.rule == LIN_THOMPSON:
            noise = settings.alpha * rng.standard_normal()
            scratch[arm] += noise * deviation(models, arm, context, solved)
    draws[0] = rng.random()
    if settings.rule != LIN_EPSILON_GREEDY:
        return greedy_action(scratch, draws[0] * settings.tie_scale)
    draws[1] = rng.random()
    return choose_action(settings.strategy, scratch, rate, settings.tie_scale, draws)


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
def learn_linear(
    models: Regressions, arm: int, context: Floats, reward: float, solved: Floats
) -> None:
    """Learn from one reward, in place; ``solved`` is room for a number for each feature."""
    add_context(models, arm, context, solved)
    for i in range(len(context)):
        models.moments[arm, i] += reward * context[i]
    models.counts[arm] += 1
    solve(models, arm)
