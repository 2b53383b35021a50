"""Looks at answers to the exercises, and says what is wrong with them: not what would be right.

No answer is kept here. Each check asks whether an answer has a property that the right one must
have, such as solving an equation, and where it has not, whether it solves the equation of a common
mistake.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from answer_faults import (
    RIGHT,
    TOLERANCE,
    Floats,
    compared,
    fault_of_array,
    looked_ahead,
    probabilities,
)

from mdp import TransitionModel


def check_policy_values(model: TransitionModel, policy: Any, discount: float, values: Any) -> str:
    """Whether values are those of a policy: they have to solve its Bellman equation.

    Args:
        model: the decision process.
        policy: an action for each state, shape (S,), or probabilities, shape (S, A).
        discount: from 0 to below 1.
        values: the answer, shape (S,).
    """
    chances = probabilities(model, policy)
    wrong = fault_of_array(values, (model.n_states,), "one value for each state")
    if wrong:
        return wrong
    found = np.asarray(values, dtype=float)
    ahead = (chances * looked_ahead(model, discount, found)).sum(axis=1)
    mistakes = {
        "They are those of an agent that always takes the best action. The policy does not.": (
            looked_ahead(model, discount, found).max(axis=1)
        ),
        "They go on after the end: when an outcome terminates, nothing follows it.": (
            chances * looked_ahead(model, discount, found, endless=True)
        ).sum(axis=1),
        "The discount is missing: what follows counts less than the reward now.": (
            chances * looked_ahead(model, 1.0, found)
        ).sum(axis=1),
        "The reward is discounted too: only what follows it is.": (
            discount * (chances * looked_ahead(model, 1.0, found)).sum(axis=1)
        ),
    }
    return compared(found, ahead, model.reachable, mistakes)


def check_optimal_values(model: TransitionModel, discount: float, values: Any) -> str:
    """Whether values are the optimal ones: they have to solve Bellman's optimality equation.

    Args:
        model: the decision process.
        discount: from 0 to below 1.
        values: the answer, shape (S,).
    """
    wrong = fault_of_array(values, (model.n_states,), "one value for each state")
    if wrong:
        return wrong
    found = np.asarray(values, dtype=float)
    ahead = looked_ahead(model, discount, found)
    mistakes = {
        "They are those of random actions: take the best action, not the mean of all.": ahead.mean(
            axis=1
        ),
        "They go on after the end: when an outcome terminates, nothing follows it.": looked_ahead(
            model, discount, found, endless=True
        ).max(axis=1),
        "They are those of the worst actions: is there a min in the place of a max?": ahead.min(
            axis=1
        ),
    }
    said = compared(found, ahead.max(axis=1), model.reachable, mistakes)
    off = np.abs(ahead.max(axis=1) - found)[model.reachable].max()
    if said != RIGHT and TOLERANCE < off < 0.05 * np.abs(found).max():
        said += " They are near: perhaps there were too few sweeps."
    return said


def check_action_values(
    model: TransitionModel, discount: float, values: Any, action_values: Any
) -> str:
    """Whether values of actions follow from values of states, by one step ahead.

    Args:
        model: the decision process.
        discount: from 0 to 1.
        values: of the states, shape (S,).
        action_values: the answer, shape (S, A).
    """
    shape = (model.n_states, model.n_actions)
    wrong = fault_of_array(action_values, shape, "one for each state and action")
    if wrong:
        return wrong
    found, known = np.asarray(action_values, dtype=float), np.asarray(values, dtype=float)
    mistakes = {
        "They go on after the end: when an outcome terminates, nothing follows it.": looked_ahead(
            model, discount, known, endless=True
        ),
        "The discount is missing.": looked_ahead(model, 1.0, known),
    }
    return compared(found, looked_ahead(model, discount, known), model.reachable, mistakes)


def check_greedy(model: TransitionModel, discount: float, values: Any, policy: Any) -> str:
    """Whether a policy is greedy in some values.

    Args:
        model: the decision process.
        discount: from 0 to 1.
        values: of the states, shape (S,).
        policy: the answer, an action for each state, shape (S,).
    """
    wrong = fault_of_array(policy, (model.n_states,), "one action for each state")
    if wrong:
        return wrong
    chosen = np.asarray(policy)
    if not np.isin(chosen, np.arange(model.n_actions)).all():
        return f"Actions are the numbers 0 to {model.n_actions - 1}."
    ahead = looked_ahead(model, discount, np.asarray(values, dtype=float))
    missed = ahead.max(axis=1) - ahead[np.arange(model.n_states), chosen.astype(int)]
    missed[~model.reachable] = 0
    worst = int(missed.argmax())
    if missed[worst] <= TOLERANCE:
        return RIGHT
    return (
        f"{(missed > TOLERANCE).sum()} states have a better action by these values. "
        f"In state {worst} the action {int(chosen[worst])} gives away {missed[worst]:.4g}."
    )


def check_target(target: Callable[..., float], kind: str) -> str:
    """Whether a function is the target of a TD update, tried on steps drawn at random.

    Args:
        target: called with reward, discount, terminated and next_values, shape (A,); for
            ``"sarsa"`` with next_action too, and for ``"expected_sarsa"`` with epsilon.
        kind: ``"qlearning"``, ``"sarsa"`` or ``"expected_sarsa"``.
    """
    rng = np.random.default_rng(0)
    values, reward = rng.normal(size=4), 1.5
    more: dict[str, Any] = {"sarsa": {"next_action": 1}, "expected_sarsa": {"epsilon": 0.4}}.get(
        kind, {}
    )

    def told(discount: float, terminated: bool, following: Floats, **changed: Any) -> float:
        return float(target(reward, discount, terminated, following, **{**more, **changed}))

    try:
        ended, blind = told(0.9, True, values), told(0.0, False, values)
        usual, higher = told(0.9, False, values), told(0.9, False, values + 1)
    except (TypeError, ValueError, IndexError, NameError) as fault:
        return f"It cannot be called or gives no number: {fault}"
    if not np.isfinite([ended, blind, usual, higher]).all():
        return "It gives a number that is not finite."
    if abs(ended - reward) > TOLERANCE:
        return "When the episode has terminated nothing follows: the target is the reward alone."
    if abs(blind - reward) > TOLERANCE:
        return "With a discount of 0 only the reward should count."
    if abs(higher - usual - 0.9) > TOLERANCE:
        return (
            "If all next values rise by 1, the target has to rise by the discount, here 0.9; yours "
            f"rises by {higher - usual:.4g}."
        )
    return fault_of_target(told, kind, values)


def fault_of_target(told: Callable[..., float], kind: str, values: Floats) -> str:
    """What a target depends on that it should not, or does not and should."""
    base = told(1.0, False, values)
    slopes = np.array([told(1.0, False, values + step) - base for step in 1e-3 * np.eye(4)]) / 1e-3
    best = int(values.argmax())
    if kind == "qlearning" and slopes[best] < 1 - 1e-3:
        return "If the best next value rises by a little, the target has to rise by as much."
    if kind == "sarsa" and slopes[1] < 1 - 1e-3:
        return "The target has to follow the value of the next action, and of that one alone."
    if kind == "expected_sarsa":
        return fault_of_mean(told, values, slopes)
    return RIGHT


def fault_of_mean(told: Callable[..., float], values: Floats, slopes: Floats) -> str:
    """What is wrong with the probabilities in the target of Expected SARSA."""
    best = int(values.argmax())
    greedy, even = (told(1.0, False, values, epsilon=epsilon) for epsilon in (0.0, 1.0))
    all_best, all_mean = (
        told(1.0, False, np.full(4, value)) for value in (values.max(), values.mean())
    )
    if np.ptp(np.delete(slopes, best)) > 1e-3:
        return "Actions that are not the best are equally probable: all must count alike."
    if abs(greedy - all_best) > TOLERANCE:
        return "With epsilon 0 the policy is greedy, and only the best action counts."
    if abs(even - all_mean) > TOLERANCE:
        return "With epsilon 1 all actions are equally probable, the best one included."
    if abs(slopes[best] - slopes.min() - 0.6) > 1e-3:
        return "The random action can be the best one too: how probable is that one in all?"
    return RIGHT


def check_regret(means: Any, arms: Any, regret: Any) -> str:
    """Whether numbers are the regret after each pull, in the expected rewards.

    Args:
        means: the expected reward of each arm, shape (K,).
        arms: which arm was pulled, shape (T,).
        regret: the answer, summed up over the pulls so far, shape (T,).
    """
    pulled, worth = np.asarray(arms), np.asarray(means, dtype=float)
    wrong = fault_of_array(regret, pulled.shape, "one number for each pull")
    if wrong:
        return wrong
    steps = np.diff(np.asarray(regret, dtype=float), prepend=0.0)
    if (steps < -TOLERANCE).any():
        return (
            f"Regret never falls, but yours does at pull {int((steps < -TOLERANCE).argmax()) + 1}."
        )
    if (np.abs(steps[worth[pulled] == worth.max()]) > TOLERANCE).any():
        return "A pull of the best arm loses nothing: it must not add anything."
    for arm in np.unique(pulled):
        own = steps[pulled == arm]
        if np.ptp(own) > TOLERANCE:
            return (
                f"Pulls of arm {arm} add different amounts. Expected rewards count, not those that "
                "chance has paid."
            )
        if abs(own[0] - (worth.max() - worth[arm])) > TOLERANCE:
            return f"A pull of arm {arm} adds the wrong amount: what would the best arm have paid?"
    return RIGHT


def check_index(index: Callable[..., float]) -> str:
    """Whether a function can be the index of UCB1, tried on numbers drawn at random.

    Args:
        index: called with the mean of an arm, the number of its pulls, and that of all pulls.
    """
    try:
        usual, better = float(index(0.4, 10, 100)), float(index(0.5, 10, 100))
        tried, later = float(index(0.4, 40, 100)), float(index(0.4, 10, 10_000))
    except (TypeError, ValueError) as fault:
        return f"It cannot be called or gives no number: {fault}"
    if abs(better - usual - 0.1) > TOLERANCE:
        return "If the mean rises by 0.1, the index has to rise by as much."
    if not usual > 0.4:
        return "The index has to lie above the mean: where is the bonus?"
    if abs((usual - 0.4) - 2 * (tried - 0.4)) > TOLERANCE:
        return "With four times as many pulls of the arm its bonus has to be half as large."
    if abs((later - 0.4) - np.sqrt(2) * (usual - 0.4)) > TOLERANCE:
        return "The bonus has to grow with all pulls, but slowly: by the root of their logarithm."
    if abs(float(index(0.0, 1, np.e**2)) - 2.0) > 1e-3:
        return "The form is right, but a factor is not: what stands before the logarithm in UCB1?"
    return RIGHT
