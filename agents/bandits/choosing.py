"""How the agents that keep a score for each arm choose one.

Pure compiled functions, shared by the interpreted and the compiled loop; `choose_arm` draws its
random numbers from the generator that it is handed.
"""

from __future__ import annotations

import math

import numpy as np

from agents.bandits.kl import kl_upper_bound
from agents.bandits.tables import (
    BETA_THOMPSON,
    EXP3,
    GAUSSIAN_THOMPSON,
    GRADIENT,
    KL_UCB,
    UCB,
    Floats,
    Settings,
    Tables,
    total_count,
)
from agents.common.exploration import (
    BOLTZMANN,
    boltzmann_action,
    choose_action,
    greedy_action,
    highest_value,
)
from mdp.machine_code import inlined


@inlined
def ucb_index(mean: float, count: int, pulls: int, parameters: tuple[float, float, float]) -> float:
    """Mean plus c sqrt(factor ln(pulls + offset) / count), where parameters = (c, factor, offset).

    UCB1 (Auer et al., 2002) has factor 2 and the number of pulls so far; Sutton and Barto, section
    2.7, have factor 1 and count the pull to come.
    """
    c, factor, offset = parameters
    return mean + c * math.sqrt(factor * math.log(pulls + offset) / count)


@inlined
def kl_ucb_index(
    mean: float, count: int, pulls: int, parameters: tuple[float, float, float]
) -> float:
    """The highest q with count * kl(mean, q) <= ln(pulls) + c ln(ln(pulls)); parameters = (c,).

    Garivier and Cappe, 2011.
    """
    log_pulls = math.log(pulls)
    return kl_upper_bound(mean, (log_pulls + parameters[0] * math.log(max(log_pulls, 1.0))) / count)


@inlined
def upper_bounds(settings: Settings, tables: Tables, row: int, scratch: Floats) -> None:
    """Fill in the index of each arm, infinite for those not tried."""
    pulls = total_count(tables, row)
    for arm in range(len(scratch)):
        count = tables.counts[row, arm]
        mean = tables.scores[row, arm]
        if count == 0:
            scratch[arm] = math.inf
        elif settings.rule == UCB:
            scratch[arm] = ucb_index(mean, count, pulls, settings.parameters)
        else:
            scratch[arm] = kl_ucb_index(mean, count, pulls, settings.parameters)


@inlined
def posterior_samples(
    settings: Settings, tables: Tables, row: int, rng: np.random.Generator, scratch: Floats
) -> None:
    """Fill in a draw from the posterior of each arm's mean (Thompson, 1933).

    Bernoulli rewards: parameters = (a, b) of the Beta prior. Gaussian rewards: parameters = (prior
    mean, prior precision, precision of a reward).
    """
    first, second, third = settings.parameters
    for arm in range(len(scratch)):
        count = tables.counts[row, arm]
        if settings.rule == BETA_THOMPSON:
            successes = tables.sums[row, arm]
            scratch[arm] = rng.beta(first + successes, second + count - successes)
        else:
            deviation = 1.0 / math.sqrt(second + count * third)
            scratch[arm] = tables.scores[row, arm] + deviation * rng.standard_normal()


@inlined
def softmax(tables: Tables, row: int, probabilities: Floats) -> None:
    """Fill in the probability of each arm, proportional to exp(score)."""
    for arm in range(len(probabilities)):
        probabilities[arm] = tables.scores[row, arm]
    highest = highest_value(probabilities)
    total = 0.0
    for arm in range(len(probabilities)):
        probabilities[arm] = math.exp(probabilities[arm] - highest)
        total += probabilities[arm]
    for arm in range(len(probabilities)):
        probabilities[arm] /= total


@inlined
def exp3_probabilities(settings: Settings, tables: Tables, row: int, probabilities: Floats) -> None:
    """Fill in softmax mixed with uniform (Auer et al., 2002); parameters = (share of uniform,)."""
    softmax(tables, row, probabilities)
    mixing = settings.parameters[0]
    for arm in range(len(probabilities)):
        probabilities[arm] = (1.0 - mixing) * probabilities[arm] + mixing / len(probabilities)


@inlined
def drawn_arm(probabilities: Floats, uniform: float) -> int:
    """The arm on which ``uniform``, in [0, 1), falls."""
    for arm in range(len(probabilities) - 1):
        uniform -= probabilities[arm]
        if uniform < 0.0:
            return arm
    return len(probabilities) - 1


@inlined
def choose_arm(
    settings: Settings,
    tables: Tables,
    row: int,
    rate: float,
    rng: np.random.Generator,
    draws: Floats,
    scratch: Floats,
) -> int:
    """Choose an arm.

    Args:
        settings: the agent.
        tables: what it knows.
        row: the context.
        rate: epsilon or temperature of the agents that explore by it.
        rng: the agent's generator.
        draws: room for 2 numbers.
        scratch: room for a number for each arm.
    """
    if settings.rule in (BETA_THOMPSON, GAUSSIAN_THOMPSON):
        posterior_samples(settings, tables, row, rng, scratch)
        return greedy_action(scratch, 0.0)
    draws[0] = rng.random()
    if settings.rule in (UCB, KL_UCB):
        upper_bounds(settings, tables, row, scratch)
        return greedy_action(scratch, draws[0] * settings.tie_scale)
    if settings.rule == EXP3:
        exp3_probabilities(settings, tables, row, scratch)
        return drawn_arm(scratch, draws[0])
    for arm in range(len(scratch)):
        scratch[arm] = tables.scores[row, arm]
    if settings.rule == GRADIENT:
        return boltzmann_action(scratch, 1.0, draws)
    if settings.strategy != BOLTZMANN:
        draws[1] = rng.random()
    return choose_action(settings.strategy, scratch, rate, settings.tie_scale, draws)


@inlined
def choice_probability(
    settings: Settings, tables: Tables, row: int, arm: int, scratch: Floats
) -> float:
    """How likely the choice of ``arm`` was, where the update needs to know; else 1."""
    if settings.rule != EXP3:
        return 1.0
    exp3_probabilities(settings, tables, row, scratch)
    return float(scratch[arm])
