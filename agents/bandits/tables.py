"""What the agents that keep a score for each arm in each context know, and how they are set."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mdp.machine_code import inlined

VALUES = 0
UCB = 1
KL_UCB = 2
GRADIENT = 3
BETA_THOMPSON = 4
GAUSSIAN_THOMPSON = 5
EXP3 = 6

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Settings(NamedTuple):
    """How an agent chooses and learns.

    Attributes:
        rule: which rule.
        strategy: exploration strategy of the rules that explore around their values.
        sample_average: step size 1/N.
        tie_scale: 1 to break ties at random, 0 to take the first best arm.
        parameters: what else the rule takes; each function names its own.
    """

    rule: int
    strategy: int
    sample_average: bool
    tie_scale: float
    parameters: tuple[float, float, float]


class Tables(NamedTuple):
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
def total_count(tables: Tables, row: int) -> int:
    """Rewards seen in a context."""
    total = 0
    for arm in range(tables.counts.shape[1]):
        total += tables.counts[row, arm]
    return total


@inlined
def mean_reward(tables: Tables, row: int) -> float:
    """Average of all rewards seen in a context, at least one."""
    total = 0.0
    for arm in range(tables.sums.shape[1]):
        total += tables.sums[row, arm]
    return total / total_count(tables, row)
