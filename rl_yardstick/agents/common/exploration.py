"""Chooses an action by the values of all actions.

All functions are pure and compiled. They take their random numbers as arguments, so an interpreted
and a compiled loop with the same generator choose the same actions. A choice takes a row of
`draws_per_choice` numbers: standard normal ones for `GAUSSIAN_NOISE`, else uniform in [0, 1).

Sutton and Barto (2nd edition): epsilon-greedy section 2.2, softmax section 2.8.
"""

from __future__ import annotations

import math

import numpy as np

from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats

EPSILON_GREEDY = 0
BOLTZMANN = 1
GAUSSIAN_NOISE = 2

STRATEGIES = {
    "epsilon_greedy": EPSILON_GREEDY,
    "boltzmann": BOLTZMANN,
    "gaussian_noise": GAUSSIAN_NOISE,
}


def draws_per_choice(strategy: int, n_actions: int) -> int:
    """Number of random numbers that one choice among ``n_actions`` consumes."""
    if strategy == GAUSSIAN_NOISE:
        return n_actions
    return 2 if strategy == EPSILON_GREEDY else 1


@inlined
def highest_value(values: Floats) -> float:
    """The highest of ``values``, shape (A,); a plain loop is faster here than NumPy's."""
    highest = values[0]
    for action in range(1, len(values)):
        highest = max(highest, values[action])
    return float(highest)


@inlined
def greedy_action(values: Floats, uniform: float) -> int:
    """An action of highest value; ``uniform`` breaks ties, and 0 takes the first, like argmax."""
    # Without branches: a processor cannot predict well which value is higher.
    highest = values[0]
    best_action = 0
    n_best = 1
    for action in range(1, len(values)):
        value = values[action]
        n_best = 1 if value > highest else n_best + (value == highest)
        best_action = action if value > highest else best_action
        highest = value if value > highest else highest
    if n_best == 1:
        return best_action
    skip = int(uniform * n_best)
    for action in range(best_action, len(values)):
        if values[action] == highest:
            if skip == 0:
                return action
            skip -= 1
    return best_action


@inlined
def random_action(strategy: int, n_actions: int, rate: float, draws: Floats) -> int:
    """A random action chosen regardless of the values; -1 if the values decide."""
    if strategy == EPSILON_GREEDY and draws[0] < rate:
        return int(draws[1] * n_actions)
    return -1


@inlined
def epsilon_greedy_action(values: Floats, epsilon: float, tie_scale: float, draws: Floats) -> int:
    """A uniformly random action with probability ``epsilon``, else a greedy one."""
    action = random_action(EPSILON_GREEDY, len(values), epsilon, draws)
    return action if action >= 0 else greedy_action(values, draws[1] * tie_scale)


@inlined
def softmax_weight(value: float, highest: float, temperature: float) -> float:
    """exp((value - highest) / temperature), or its limit if the temperature is 0."""
    if temperature <= 0.0:
        return 1.0 if value == highest else 0.0
    return math.exp((value - highest) / temperature)


@inlined
def boltzmann_action(values: Floats, temperature: float, draws: Floats) -> int:
    """An action with probability proportional to exp(value / temperature)."""
    highest = highest_value(values)
    total = 0.0
    for action in range(len(values)):
        total += softmax_weight(values[action], highest, temperature)
    remaining = draws[0] * total
    for action in range(len(values) - 1):
        remaining -= softmax_weight(values[action], highest, temperature)
        if remaining < 0.0:
            return action
    return len(values) - 1


@inlined
def make_probabilities(preferences: Floats) -> None:
    """Turn preferences into the probabilities of their softmax, in place, shape (A,)."""
    highest, total = highest_value(preferences), 0.0
    for action in range(len(preferences)):
        preferences[action] = math.exp(preferences[action] - highest)
        total += preferences[action]
    for action in range(len(preferences)):
        preferences[action] /= total


@inlined
def drawn_action(probabilities: Floats, uniform: float) -> int:
    """Draw an action by its probability with ``uniform``, a number in [0, 1)."""
    for action in range(len(probabilities) - 1):
        uniform -= probabilities[action]
        if uniform < 0.0:
            return action
    return len(probabilities) - 1


@inlined
def noisy_greedy_action(values: Floats, noise_std: float, draws: Floats) -> int:
    """The best action after adding Gaussian noise (``noise_std``) to each value."""
    best_action = 0
    best_value = values[0] + noise_std * draws[0]
    for action in range(1, len(values)):
        value = values[action] + noise_std * draws[action]
        if value > best_value:
            best_action = action
            best_value = value
    return best_action


@inlined
def choose_action(
    strategy: int, values: Floats, rate: float, tie_scale: float, draws: Floats
) -> int:
    """Choose an action by ``strategy``.

    ``rate`` is epsilon, a temperature or a standard deviation; ``tie_scale`` 1 breaks ties at
    random, 0 takes the first; ``draws`` are random numbers, shape (draws_per_choice,).
    """
    if strategy == EPSILON_GREEDY:
        return epsilon_greedy_action(values, rate, tie_scale, draws)
    if strategy == BOLTZMANN:
        return boltzmann_action(values, rate, draws)
    return noisy_greedy_action(values, rate, draws)


@inlined
def expected_value(strategy: int, values: Floats, rate: float) -> float:
    """Mean of ``values``, shape (A,), under the exploring policy.

    Ties do not matter, because tied actions have equal values. Gaussian noise has no closed form,
    so agents that need this mean refuse it.
    """
    highest = highest_value(values)
    if strategy == EPSILON_GREEDY:
        total = 0.0
        for action in range(len(values)):
            total += values[action]
        return rate * total / len(values) + (1.0 - rate) * highest
    total = 0.0
    weighted = 0.0
    for action in range(len(values)):
        weight = softmax_weight(values[action], highest, rate)
        total += weight
        weighted += weight * values[action]
    return weighted / total


@inlined
def action_probability(
    strategy: int, values: Floats, rate: float, tie_scale: float, action: int
) -> float:
    """The probability of one action; equals its entry in `action_probabilities`."""
    highest = highest_value(values)
    if strategy == EPSILON_GREEDY:
        n_best, n_before = 0, 0
        for other in range(len(values)):
            if values[other] == highest:
                n_best += 1
                n_before += other < action
        share = 1.0 / n_best if tie_scale > 0.0 else 1.0
        is_chosen = values[action] == highest and (tie_scale > 0.0 or n_before == 0)
        greedy = share if is_chosen else 0.0
        return rate / len(values) + (1.0 - rate) * greedy
    total = 0.0
    for other in range(len(values)):
        total += softmax_weight(values[other], highest, rate)
    return softmax_weight(values[action], highest, rate) / total


def action_probabilities(
    strategy: int, values: Floats, rate: float, *, random_ties: bool, masks: Bools | None = None
) -> Floats:
    """The exploring policy as a matrix of the shape of ``values``, (S, A).

    If a row of ``masks`` is all False, or ``masks`` has no rows, all actions are allowed.
    """
    if strategy == GAUSSIAN_NOISE:
        raise ValueError("Gaussian noise on the values has no closed-form action probabilities")
    allowed = np.ones(values.shape, dtype=np.bool_)
    if masks is not None and len(masks):
        allowed = masks | ~masks.any(axis=1, keepdims=True)
        values = np.where(allowed, values, -np.inf)
    highest = values.max(axis=1, keepdims=True)
    if strategy == BOLTZMANN:
        weights = np.exp((values - highest) / rate) if rate > 0 else (values == highest) * 1.0
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))
    greedy = (values == highest).astype(np.float64)
    if not random_ties:
        greedy = np.eye(values.shape[1])[values.argmax(axis=1)]
    greedy /= greedy.sum(axis=1, keepdims=True)
    random = rate * allowed / allowed.sum(axis=1, keepdims=True)
    return np.asarray(random + (1.0 - rate) * greedy)
