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
    answering,
    compared,
    fault_of_array,
    given_back,
    looked_ahead,
    number_from,
    probabilities,
)

from rl_yardstick.mdp import TransitionModel, finite_horizon_optimum, policy_return, value_iteration


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


@answering
def check_action_values(
    model: TransitionModel, discount: float, action_values: Callable[..., Any]
) -> str:
    """Whether a function gives action values, by one step ahead; tried on values drawn at random.

    Args:
        model: the decision process.
        discount: from 0 to 1.
        action_values: called with the values of the states, shape (S,); gives shape (S, A).
    """
    # States in which an episode ends have values too, and these must not count.
    known = np.random.default_rng(0).normal(size=model.n_states)
    given = given_back(action_values, known.copy())
    shape = (model.n_states, model.n_actions)
    wrong = fault_of_array(given, shape, "one for each state and action")
    if wrong:
        return wrong
    ahead = looked_ahead(model, discount, known)
    mistakes = {
        "They go on after the end: when an outcome terminates, nothing follows it.": looked_ahead(
            model, discount, known, endless=True
        ),
        "The discount is missing.": looked_ahead(model, 1.0, known),
        "The reward is discounted too: only what follows it is.": (
            discount * looked_ahead(model, 1.0, known)
        ),
        "The probability of the action counts. It must not: the action is taken.": (
            ahead / model.n_actions
        ),
    }
    return compared(np.asarray(given, dtype=float), ahead, model.reachable, mistakes)


def check_improvable(model: TransitionModel, discount: float, values: Any, states: Any) -> str:
    """Whether these are the states in which one action, taken once, beats random actions.

    Args:
        model: the decision process.
        discount: from 0 to below 1.
        values: those of random actions, shape (S,).
        states: the answer, numbers of states.
    """
    if states is None or states is Ellipsis:
        return "Not done yet."
    named = np.unique(np.asarray(states))
    if not np.isin(named, np.flatnonzero(model.reachable)).all():
        return "In some of these states no episode goes on, or there are no such states."
    ahead = looked_ahead(model, discount, np.asarray(values, dtype=float))
    gains = np.where(model.reachable, ahead.max(axis=1) - values, 0.0)
    better = np.flatnonzero(gains > TOLERANCE)
    if not np.isin(named, better).all():
        return f"In state {np.setdiff1d(named, better)[0]} no action beats random actions."
    if len(named) < len(better):
        return f"{len(better) - len(named)} states are missing. Small gains count too."
    return RIGHT


@answering
def check_greedy(model: TransitionModel, greedy: Callable[..., Any]) -> str:
    """Whether a function gives greedy policies, tried on values drawn at random.

    Args:
        model: the decision process.
        greedy: called with values, shape (S,), and a discount; gives an action for each state.
    """
    values, states = 50 * np.random.default_rng(0).normal(size=model.n_states), model.reachable

    def lost(chosen: Floats, discount: float, *, endless: bool = False) -> Floats:
        ahead = looked_ahead(model, discount, values, endless=endless)
        taken = ahead[np.arange(model.n_states), chosen.astype(int)]
        return np.where(states, ahead.max(axis=1) - taken, 0.0)

    for discount in (0.9, 0.1):
        given = given_back(greedy, values.copy(), discount)
        wrong = fault_of_array(given, (model.n_states,), "one action for each state")
        if wrong:
            return wrong
        chosen = np.asarray(given, dtype=float)
        if not np.isin(chosen, np.arange(model.n_actions)).all():
            return f"Actions are the numbers 0 to {model.n_actions - 1}."
        losses = lost(chosen, discount)
        if losses.max() <= TOLERANCE:
            continue
        if lost(chosen, discount, endless=True).max() <= TOLERANCE:
            return "It goes on after the end: when an outcome terminates, nothing follows it."
        if any(lost(chosen, other).max() <= TOLERANCE for other in (0.9, 0.99, 1.0)):
            return "It is greedy for another discount than the one that it is called with."
        worst = int(losses.argmax())
        return (
            f"{(losses > TOLERANCE).sum()} states have a better action by these values. "
            f"In state {worst} the action {int(chosen[worst])} gives away {losses[worst]:.4g}."
        )
    return RIGHT


@answering
def check_sweep(model: TransitionModel, discount: float, sweep: Callable[..., Any]) -> str:
    """Whether a function is a sweep of Gauss-Seidel, tried on values and orders drawn at random.

    Args:
        model: the decision process.
        discount: from 0 to 1.
        sweep: called with values, shape (S,), and the order of the states; gives new values.
    """
    rng, states = np.random.default_rng(0), np.flatnonzero(model.reachable)
    old, order = rng.normal(size=model.n_states), rng.permutation(states)
    given = given_back(sweep, old.copy(), order.copy())
    wrong = fault_of_array(given, old.shape, "one value for each state")
    if wrong:
        return wrong
    new = np.asarray(given, dtype=float)

    def agrees(order: Any, *, at_once: bool = False) -> bool:
        known, is_same = old.copy(), True
        for state in order:
            best = looked_ahead(model, discount, known)[state].max()
            is_same &= bool(abs(best - new[state]) < TOLERANCE)
            known[state] = old[state] if at_once else new[state]
        return is_same

    if agrees(order):
        return RIGHT
    if agrees(order, at_once=True):
        return "Each state sees old values only. It has to see the new ones of the states before."
    if agrees(states):
        return "It goes from first to last, whatever the order that it is called with."
    return "A new value is not the best of one step ahead, from new values before and old ones."


@answering
def check_threshold(model: TransitionModel, start: int, threshold: Any) -> str:
    """Whether below a discount it is best never to arrive, and above it is not; to 0.005.

    Args:
        model: a decision process in which the cheapest step costs 1.
        start: the state where episodes begin.
        threshold: the answer.
    """
    if threshold is None or threshold is Ellipsis:
        return "Not done yet."
    answer = number_from(lambda: threshold)
    if not 0 < answer < 1:
        return "A discount lies between 0 and 1."

    def gain(discount: float) -> float:
        """The optimal value less that of a robot that never arrives."""
        return float(value_iteration(model, discount).values[start] + 1 / (1 - discount))

    if gain(max(answer - 0.005, 0.0)) > 1e-9:
        return "A little below it, the goal is still worth the way. What do the best actions do?"
    if gain(min(answer + 0.005, 0.999)) <= 1e-9:
        return "A little above it, the best robot still never arrives. Let it pay 1 for each step."
    return RIGHT


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


@answering
def check_epsilon(epsilon: Callable[..., float]) -> str:
    """Whether epsilon falls as fast as a regret like a logarithm needs, by its exponent.

    Args:
        epsilon: called with the number of the pull, from 1 on.
    """
    pulls = np.array([1e2, 1e3, 1e6, 1e8])
    found = np.array([number_from(epsilon, pull) for pull in pulls])
    if (found < 0).any():
        return "A probability is not below 0."
    if (found == 0).any():
        return "From some pull on it never explores: a run on a bad arm stays there for ever."
    exponent = np.log(found[3] / found[2]) / np.log(pulls[3] / pulls[2])
    if exponent > -0.05:
        return "It does not fall for ever, so regret grows along a straight line in the end."
    if exponent > -0.9:
        return f"It falls too slowly: regret grows like the power {1 + exponent:.2g} of the pulls."
    if exponent < -1.1:
        return (
            "It falls too fast: even in endless runs the random pulls add up to a finite number, "
            "and some runs stay on a bad arm."
        )
    return RIGHT


def check_ways(model: TransitionModel, tables: Any) -> str:
    """Whether the greedy policies of tables are optimal, one table for each seed.

    Args:
        model: the decision process.
        tables: the answer, shape (seeds, S, A).
    """
    shape = (np.shape(tables)[0] if np.ndim(tables) == 3 else 5, model.n_states, model.n_actions)
    wrong = fault_of_array(tables, shape, "a table for each seed")
    if wrong:
        return wrong
    if shape[0] < 5:
        return "One table may be luck: take five seeds."
    returns = np.array(
        [policy_return(model, table.argmax(axis=1), 1000).expected_return for table in tables]
    )
    lost = finite_horizon_optimum(model, 1000).start_value - returns
    if lost.max() <= TOLERANCE:
        return RIGHT
    if (returns <= -1000 + TOLERANCE).any():
        return f"On seed {int(returns.argmin())} the greedy policy never arrives."
    return (
        f"On {(lost > TOLERANCE).sum()} of {len(lost)} seeds the way is longer than the shortest: "
        "how often does SARSA still try another way, once it has a safe one?"
    )
