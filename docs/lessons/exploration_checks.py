"""Looks at answers to the exercises on exploration; see `checker`."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import numpy as np
from answer_faults import RIGHT, TOLERANCE, Ints, answering, number_from
from checker import check_target

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import TransitionModel, policy_return, value_iteration

SIZES, EPSILONS = (3, 5), (1.0, 0.5, 0.1)


@answering
def check_divergence(divergence: Callable[..., float]) -> str:
    """Whether a function is the divergence of two probabilities, by how it changes with them.

    Args:
        divergence: called with p, what an arm pays, and q, what the best arm pays.
    """

    def between(p: float, q: float) -> float:
        return number_from(divergence, p, q)

    if abs(between(0.3, 0.3)) > TOLERANCE:
        return "For two equal probabilities it has to be 0: nothing can tell them apart."
    up, down = between(0.3, 0.6), between(0.6, 0.3)
    if up <= 0 and down <= 0:
        return "It has to be above 0 wherever p and q differ: is a fraction upside down?"
    if up <= 0 or down <= 0:
        return "It falls below 0. A pull can pay 1 and it can pay 0: are both of them counted?"
    if abs(between(0.2, 0.6) - between(0.8, 0.4)) > TOLERANCE:
        return "Call a success a failure, and the other way round: it must not change. It does."
    return fault_of_slope(between)


def fault_of_slope(between: Callable[[float, float], float]) -> str:
    """What is wrong with how a divergence changes with its second probability."""
    places, step = np.array([(0.2, 0.7), (0.5, 0.75), (0.6, 0.3)]), 1e-5
    by_q = [(between(p, q + step) - between(p, q - step)) / (2 * step) for p, q in places]
    by_p = [(between(p + step, q) - between(p - step, q)) / (2 * step) for p, q in places]
    first, second = places.T
    ratios = np.array(by_q) * second * (1 - second) / (second - first)
    if np.abs(ratios - 1).max() < 1e-4:
        return RIGHT
    if np.ptp(ratios) < 1e-4:
        return "The form is right, but all of it is multiplied by something: which logarithm is it?"
    swapped = np.array(by_p) * first * (1 - first) / (first - second)
    if np.abs(swapped - 1).max() < 1e-4:
        return (
            "The two are the wrong way round: pulls are drawn with p, so p weighs the logarithms."
        )
    return "It is 0 where it has to be and above 0 elsewhere, but grows in another way with q."


def chance_of_treasure(size: int, epsilon: float) -> float:
    """The exact chance of an episode, for a diver who turns away unless chance decides."""
    model = transition_model(gym.make("DeepSea-v0", size=size, map_seed=None))
    turning_away = epsilon / 2 + (1 - epsilon) * np.eye(2)[np.zeros(model.n_states, dtype=int)]
    found = policy_return(model, turning_away, horizon=size, success=model.reward > 0.5)
    return float(found.success_rate or 0.0)


@answering
def check_episodes(episodes: Callable[..., float]) -> str:
    """Whether a function says how many episodes it takes in the mean to find the treasure.

    Args:
        episodes: called with the size of the sea, and epsilon.
    """
    places = [(size, epsilon) for size in SIZES for epsilon in EPSILONS]
    chances = np.array([chance_of_treasure(*place) for place in places])
    found = np.array([number_from(episodes, *place) for place in places])
    sizes, epsilons = np.array(places).T
    mistakes = {
        "That is the chance that one episode succeeds. The question is how many it takes.": chances,
        "There is one move too few: the lowest cell has to be left to the right as well.": (
            epsilons / 2 / chances
        ),
        "Those before the first success are counted. That episode itself is to be counted too.": (
            1 / chances - 1
        ),
        "Half of all divers are done by then. Those who are not raise the mean.": (
            np.log(2) / chances
        ),
        "A random action is the right one in half of the cases only.": epsilons**-sizes,
        "Epsilon is missing: by far not every action is a random one.": 2.0**sizes,
        "This diver would take the right action if chance did not. Ours turns away.": (
            (1 - epsilons / 2) ** -sizes
        ),
    }
    if np.abs(found * chances - 1).max() < 1e-4:
        return RIGHT
    for said, other in mistakes.items():
        if np.abs(found / other - 1).max() < 1e-4:
            return said
    worst = int(np.abs(np.log(np.maximum(found, 1e-12) * chances)).argmax())
    return (
        f"For {places[worst][0]} rows and epsilon {places[worst][1]:g} it is too "
        f"{'high' if found[worst] * chances[worst] > 1 else 'low'}."
    )


@answering
def check_bonus_target(target: Callable[..., float]) -> str:
    """Whether a function is Q-learning's target with a bonus for what was seldom tried.

    Args:
        target: called with reward, discount, terminated, next_values, shape (A,), count and scale.
    """
    values = np.array([0.5, 2.0, 1.0])

    def told(count: int, scale: float, discount: float = 0.9, terminated: bool = False) -> float:
        return number_from(target, 1.5, discount, terminated, values, count, scale)

    plain = check_target(lambda *arguments: _plain(target, *arguments), "qlearning")
    if plain != RIGHT:
        return f"With a scale of 0 it should be the target of Q-learning. {plain}"
    once, rarely, often = (told(count, 1.0) - told(count, 0.0) for count in (1, 4, 16))
    if abs(told(4, 1.0, terminated=True) - 1.5) < TOLERANCE < abs(rarely):
        return "There is no bonus at the end of an episode: but the last action was tried as well."
    if abs(told(4, 1.0, discount=0.5) - told(4, 0.0, discount=0.5) - rarely) > TOLERANCE:
        return "The bonus depends on the discount. It is for this step, not for what follows."
    return fault_of_bonus(once, rarely, often, told(4, 2.0) - told(4, 0.0))


def _plain(target: Callable[..., float], *arguments: object) -> float:
    return number_from(target, *arguments, 9, 0.0)


def fault_of_bonus(once: float, rarely: float, often: float, doubled: float) -> str:
    """What is wrong with bonuses after 1, 4 and 16 visits, and after 4 with twice the scale."""
    if rarely <= 0 or once <= rarely:
        return "What was tried less often should get more of a bonus, and all should get some."
    if abs(doubled - 2 * rarely) > TOLERANCE:
        return "If the scale is twice as large, so is the bonus."
    if abs(rarely - 4 * often) < TOLERANCE:
        return "The bonus falls too fast: with four times as many visits it is to be half as large."
    if abs(rarely - 2 * often) > TOLERANCE or abs(once - 2 * rarely) > TOLERANCE:
        return "With four times as many visits the bonus has to be half as large."
    if abs(once - 1) > TOLERANCE:
        return "The form is right, but a factor is not: with scale 1, what is the first bonus?"
    return RIGHT


@answering
def check_returns(returns: Callable[..., float]) -> str:
    """Whether a function gives the expected return of an optimist who makes random actions.

    Args:
        returns: called with the size of the sea, and epsilon.
    """
    for size in SIZES:
        model = transition_model(gym.make("DeepSea-v0", size=size, map_seed=None))
        best = value_iteration(model, 0.999).policy
        always_right = np.ones_like(best)

        def expected(actions: Ints, epsilon: float, model: TransitionModel = model) -> float:
            chances = epsilon / 2 + (1 - epsilon) * np.eye(2)[actions]
            return policy_return(model, chances, model.n_states).expected_return

        for epsilon in (0.0, 0.5, 0.1, 1.0):
            found, chance = number_from(returns, size, epsilon), (1 - epsilon / 2) ** size
            if abs(found - expected(best, epsilon)) < TOLERANCE:
                continue
            place = f"For {size} rows and epsilon {epsilon:g}"
            if abs(found - chance) < TOLERANCE:
                return f"{place}: that is the chance of the treasure. Moves to the right cost too."
            if abs(found - expected(always_right, epsilon)) < TOLERANCE:
                return f"{place}: out of reach of the treasure, the best action is to the left."
            if abs(found - expected(best, 2 * epsilon if epsilon <= 0.5 else 1)) < TOLERANCE:
                return f"{place}: a random action is the greedy one in half of the cases."
            side = "high" if found > expected(best, epsilon) else "low"
            return f"{place} it is too {side}."
    return RIGHT
