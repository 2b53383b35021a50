"""What the agents that keep a score for each arm learn from a reward.

Pure compiled functions, shared by the interpreted and the compiled loop.
"""

from __future__ import annotations

from agents.bandits.choosing import softmax
from agents.bandits.tables import (
    BETA_THOMPSON,
    EXP3,
    GAUSSIAN_THOMPSON,
    GRADIENT,
    KL_UCB,
    UCB,
    VALUES,
    Floats,
    Settings,
    Tables,
    mean_reward,
    total_count,
)
from agents.common.step_sizes import step_size
from mdp.machine_code import inlined


@inlined
def gradient_step(
    settings: Settings,
    tables: Tables,
    row: int,
    arm: int,
    reward: float,
    size: float,
    scratch: Floats,
) -> None:
    """Move the preferences (Sutton and Barto, section 2.8); parameters = (1 with baseline else 0,).

    The baseline is the average of the rewards before this one, and this one at the very first.
    """
    baseline = 0.0
    if settings.parameters[0] > 0.0:
        first = total_count(tables, row) == 0
        baseline = reward if first else mean_reward(tables, row)
    softmax(tables, row, scratch)
    for other in range(len(scratch)):
        chosen = 1.0 if other == arm else 0.0
        tables.scores[row, other] += size * (reward - baseline) * (chosen - scratch[other])


@inlined
def learn(
    settings: Settings,
    tables: Tables,
    row: int,
    arm: int,
    reward: float,
    probability: float,
    learning_rate: float,
    scratch: Floats,
) -> None:
    """Learn from one reward, in place.

    Args:
        settings: the agent.
        tables: what it knows.
        row: the context.
        arm: what was pulled.
        reward: what it gave.
        probability: `choice_probability` of the pull.
        learning_rate: step size, unless ``sample_average``.
        scratch: room for a number for each arm.
    """
    first, second, third = settings.parameters
    if settings.rule == GRADIENT:
        gradient_step(settings, tables, row, arm, reward, learning_rate, scratch)
    tables.counts[row, arm] += 1
    tables.sums[row, arm] += reward
    count, total = tables.counts[row, arm], tables.sums[row, arm]
    if settings.rule == VALUES:
        size = step_size(learning_rate, settings.sample_average, count)
        tables.scores[row, arm] += size * (reward - tables.scores[row, arm])
    elif settings.rule in (UCB, KL_UCB):
        tables.scores[row, arm] = total / count
    elif settings.rule == BETA_THOMPSON:
        tables.scores[row, arm] = (first + total) / (first + second + count)
    elif settings.rule == GAUSSIAN_THOMPSON:
        tables.scores[row, arm] = (second * first + third * total) / (second + third * count)
    elif settings.rule == EXP3:
        tables.scores[row, arm] += first * reward / (probability * len(scratch))
