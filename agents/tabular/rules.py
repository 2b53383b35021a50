"""The update rules, each of which differs from its siblings in its target alone.

Pure compiled functions on arrays, shared by the interpreted and the compiled training loop. A rule
bootstraps from ``tables`` of shape (T, S, A): one table, or two for double Q-learning. Termination
is folded into the discount, which is 0 then, so that a truncated episode still bootstraps.

Sutton and Barto (2nd edition): Q-learning section 6.5, SARSA 6.4, Expected SARSA 6.6, double
Q-learning 6.7 (van Hasselt, 2010).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.common.exploration import choose_action, expected_value, greedy_action, highest_value
from agents.common.step_sizes import step_size
from mdp.machine_code import inlined

Q_LEARNING = 0
SARSA = 1
EXPECTED_SARSA = 2
DOUBLE_Q_LEARNING = 3

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@inlined
def q_learning_value(next_values: Floats) -> float:
    """The best next action's value."""
    return highest_value(next_values)


@inlined
def sarsa_value(next_values: Floats, next_action: int) -> float:
    """The value of the next action that the agent has committed to."""
    return float(next_values[next_action])


@inlined
def expected_sarsa_value(next_values: Floats, strategy: int, rate: float) -> float:
    """The mean value under the exploring policy."""
    return expected_value(strategy, next_values, rate)


@inlined
def double_q_learning_value(
    next_values: Floats, tables: Floats, judge: int, next_obs: int, uniform: float
) -> float:
    """The other table's value of the action that the updated table prefers."""
    return float(tables[judge, next_obs, greedy_action(next_values, uniform)])


@inlined
def td_target(
    rule: int,
    tables: Floats,
    table: int,
    reward: float,
    discount: float,
    next_obs: int,
    next_action: int,
    strategy: int,
    rate: float,
    uniform: float,
    next_values: Floats,
) -> float:
    """Reward plus the discounted value of what follows.

    Args:
        rule: which of the four rules.
        tables: action values, shape (T, S, A).
        table: index of the table that is updated.
        reward: reward of the transition.
        discount: 0 where the transition terminated, gamma otherwise.
        next_obs: the observation after the transition.
        next_action: the action committed to there (SARSA).
        strategy: exploration strategy (Expected SARSA).
        rate: its epsilon or temperature (Expected SARSA).
        uniform: breaks ties of the choosing table (double Q-learning).
        next_values: room for the updated table's values of what follows, shape (A,).
    """
    for action in range(len(next_values)):
        next_values[action] = tables[table, next_obs, action]
    if rule == Q_LEARNING:
        value = q_learning_value(next_values)
    elif rule == SARSA:
        value = sarsa_value(next_values, next_action)
    elif rule == EXPECTED_SARSA:
        value = expected_sarsa_value(next_values, strategy, rate)
    else:
        value = double_q_learning_value(next_values, tables, 1 - table, next_obs, uniform)
    return reward + discount * value


@inlined
def update(
    rule: int,
    tables: Floats,
    visit_counts: Ints,
    obs: int,
    action: int,
    reward: float,
    discount: float,
    next_obs: int,
    next_action: int,
    learning_rate: float,
    sample_average: bool,
    strategy: int,
    rate: float,
    tie_scale: float,
    uniform: float,
    scratch: Floats,
) -> float:
    """Move one entry of ``tables`` towards its target, in place, and return the TD error.

    ``uniform`` decides which of two tables is updated, and what is left of it breaks the tie in the
    choosing table; the rules on one table do not look at it. Shapes as in `td_target`;
    ``visit_counts`` is int64 of shape (T, S, A), and ``scratch`` room for A values.
    """
    table = int(uniform * tables.shape[0])
    tie_uniform = (uniform * tables.shape[0] - table) * tie_scale
    target = td_target(
        rule,
        tables,
        table,
        reward,
        discount,
        next_obs,
        next_action,
        strategy,
        rate,
        tie_uniform,
        scratch,
    )
    visit_counts[table, obs, action] += 1
    size = step_size(learning_rate, sample_average, visit_counts[table, obs, action])
    td_error = target - tables[table, obs, action]
    tables[table, obs, action] += size * td_error
    return float(td_error)


@inlined
def behaviour_action(
    tables: Floats,
    obs: int,
    strategy: int,
    rate: float,
    tie_scale: float,
    draws: Floats,
    scratch: Floats,
) -> int:
    """Choose an action by the mean of the tables' values; ``scratch`` is room for A values."""
    for action in range(len(scratch)):
        scratch[action] = tables[0, obs, action]
        if tables.shape[0] > 1:
            scratch[action] = 0.5 * (scratch[action] + tables[1, obs, action])
    return choose_action(strategy, scratch, rate, tie_scale, draws)
