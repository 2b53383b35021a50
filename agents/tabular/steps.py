"""One step of several environments: choose for each, then update from each, in their order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.tabular.rules import behaviour_action, update
from mdp.machine_code import kernel

UNDECIDED = -1

# For rules on one table, which take no random numbers.
NO_DRAWS = np.empty(0)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@kernel
def choose_actions(
    strategy: int,
    tables: Floats,
    obs: Ints,
    rate: float,
    tie_scale: float,
    draws: Floats,
    actions: Ints,
    scratch: Floats,
) -> None:
    """Fill in the actions that are still `UNDECIDED`, in place.

    Args:
        strategy: exploration strategy.
        tables: action values, shape (T, S, A).
        obs: observations, shape (n_envs,).
        rate: epsilon, temperature or standard deviation.
        tie_scale: 1 to break ties at random, 0 to take the first best action.
        draws: one row of random numbers for each undecided action.
        actions: actions, shape (n_envs,).
        scratch: room for A values.
    """
    row = 0
    for i in range(len(actions)):
        if actions[i] == UNDECIDED:
            actions[i] = behaviour_action(
                tables, obs[i], strategy, rate, tie_scale, draws[row], scratch
            )
            row += 1


@kernel
def update_tables(
    rule: int,
    tables: Floats,
    visit_counts: Ints,
    obs: Ints,
    actions: Ints,
    rewards: Floats,
    terminated: Bools,
    next_obs: Ints,
    next_actions: Ints,
    gamma: float,
    learning_rate: float,
    sample_average: bool,
    skip_terminal_update: bool,
    strategy: int,
    rate: float,
    tie_scale: float,
    uniforms: Floats,
    scratch: Floats,
) -> float:
    """Update from one transition of each environment, in place.

    Args:
        rule: which update rule.
        tables: action values, shape (T, S, A).
        visit_counts: updates of each entry so far, shape (T, S, A).
        obs: observations before the step, shape (n_envs,).
        actions: what was done, shape (n_envs,).
        rewards: shape (n_envs,).
        terminated: whether the episode ended for good, shape (n_envs,).
        next_obs: observations after the step, shape (n_envs,).
        next_actions: what SARSA does next, shape (n_envs,).
        gamma: discount factor.
        learning_rate: step size, unless ``sample_average``.
        sample_average: step size 1/N instead.
        skip_terminal_update: learn nothing from a transition that terminates.
        strategy: exploration strategy.
        rate: epsilon, temperature or standard deviation.
        tie_scale: 1 to break ties at random, 0 to take the first best action.
        uniforms: one number in [0, 1) for each environment, shape (n_envs,), or `NO_DRAWS`.
        scratch: room for A values.

    Returns:
        The mean absolute TD error.
    """
    total = 0.0
    for i in range(len(obs)):
        if terminated[i] and skip_terminal_update:
            continue
        discount = 0.0 if terminated[i] else gamma
        td_error = update(
            rule,
            tables,
            visit_counts,
            obs[i],
            actions[i],
            rewards[i],
            discount,
            next_obs[i],
            next_actions[i],
            learning_rate,
            sample_average,
            strategy,
            rate,
            tie_scale,
            uniforms[i] if len(tables) > 1 else 0.0,
            scratch,
        )
        total += abs(td_error)
    return total / len(obs)
