"""One step of several environments for the interpreted loop: choose for each, learn from each."""

from __future__ import annotations

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
from agents.bandits.tables import Floats, Ints, Settings, Tables
from mdp.machine_code import compiled


@compiled
def choose_arms(
    settings: Settings, tables: Tables, rows: Ints, rate: float, rng: np.random.Generator
) -> tuple[Ints, Floats]:
    """An arm for each of the contexts ``rows``, and its `choice_probability`; shapes (n,)."""
    arms = np.empty(len(rows), dtype=np.int64)
    probabilities = np.empty(len(rows))
    draws = np.empty(2)
    scratch = np.empty(tables.scores.shape[1])
    for i in range(len(rows)):
        arms[i] = choose_arm(settings, tables, rows[i], rate, rng, draws, scratch)
        probabilities[i] = choice_probability(settings, tables, rows[i], arms[i], scratch)
    return arms, probabilities


@compiled
def learn_from(
    settings: Settings,
    tables: Tables,
    row: int,
    arm: int,
    reward: float,
    probability: float,
    learning_rate: float,
) -> None:
    """Learn from one reward; see `agents.bandits.learning.learn`."""
    scratch = np.empty(tables.scores.shape[1])
    learn(settings, tables, row, arm, reward, probability, learning_rate, scratch)


@compiled
def choose_linear_arms(
    settings: LinearSettings,
    models: Regressions,
    contexts: NDArray[np.float64],
    rate: float,
    rng: np.random.Generator,
) -> Ints:
    """An arm for each of the contexts, of shape (n, features); shape (n,)."""
    arms = np.empty(len(contexts), dtype=np.int64)
    draws = np.empty(2)
    scratch = np.empty(models.coefficients.shape[0])
    solved = np.empty(contexts.shape[1])
    for i in range(len(contexts)):
        arms[i] = choose_linear_arm(
            settings, models, contexts[i], rate, rng, draws, scratch, solved
        )
    return arms


@compiled
def learn_linear_from(models: Regressions, arm: int, context: Floats, reward: float) -> None:
    """Learn from one reward; see `agents.bandits.linear_rules.learn_linear`."""
    learn_linear(models, arm, context, reward, np.empty(len(context)))
