"""The optimum under a time limit that is too far away to matter, from planning without one.

Backwards from a limit of T steps, planning takes T sweeps over all states. Where every step costs
something, the optimum without the limit is nearly always the same number to the last digits; here
that is shown, or it is not taken.

Let V be the optimal values without the limit, let -c be the lowest of them, and let no step that
goes on earn more than -e. A step by an optimal action raises V by e or more, in the mean. An agent
that is still under way after T steps has come to max V at most, and so has lost at least
B = T e - (max V - V(start)) to chance or to actions that are not optimal. The limit spares it c at
most: to lose c by its actions is no gain. So the limit is worth no more than c times the
probability that chance alone takes the rest, B - c = x. What chance takes is a sum of T terms of
mean zero, which by Bernstein's inequality for martingales (Freedman, On Tail Probabilities for
Martingales, 1975) comes to x with a probability of at most exp(-x^2 / (2 T v + 2 b x / 3)), where
v is the largest variance of a step's term and b its largest fall.

Nor does the limit cost more than that: what is optimal without it is under way after T steps with a
probability that is smaller still, and might then have earned max V more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mdp.array_types import AnyInts, Bools, Floats
from mdp.machine_code import compiled
from mdp.optimal_policies import value_iteration
from mdp.transition_model import TransitionModel

# The limit may change the optimum by this, relative to it where it is above 1.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Drift:
    """How values change on the way, over all states and actions that can be met.

    Attributes:
        step_cost: no step that goes on earns more than minus this.
        fall: the largest fall of the value below its mean in one step.
        variance: the largest variance of the value after a step.
    """

    step_cost: float
    fall: float
    variance: float


def optimum_far_from_limit(model: TransitionModel, horizon: int) -> float | None:
    """The highest expected return under the time limit, without going through its steps.

    Args:
        model: the decision process.
        horizon: the time limit in steps.

    Returns:
        The mean over the starting states, within 1e-9 of it (relative, where it is above 1), the
        error bound of planning included. None where that cannot be shown, as where the limit is
        near, or steps cost nothing.
    """
    if not (model.terminated & (model.prob > 0)).any():
        return None  # a task that never ends: to find out what it earns for ever takes longest
    try:
        plan = value_iteration(model, 1.0)
    except ValueError:
        return None  # without a limit there is no finite optimum
    reached = model.reachable
    values = plan.values[reached]
    if not (np.isfinite(values).all() and np.isfinite(plan.error_bound)):
        return None
    lowest_start = float(plan.values[model.initial > 0].min())
    highest, lowest = max(float(values.max()), 0.0), min(float(values.min()), 0.0)
    drift = Drift(*_drift(*_arrays(model), reached, plan.values))
    slack = 4 * plan.error_bound  # of differences of values, each known to within the bound
    overdue = horizon * drift.step_cost - (highest - lowest_start) - slack
    chance = _chance_of_losing(overdue + lowest - slack, drift, slack, horizon)
    error = plan.error_bound + max(-lowest, highest) * chance
    return plan.start_value if error <= TOLERANCE * max(1.0, abs(plan.start_value)) else None


def _chance_of_losing(loss: float, drift: Drift, slack: float, horizon: int) -> float:
    """A bound on the probability that chance alone takes so much."""
    if loss <= 0 or drift.step_cost <= 0:
        return 1.0
    fall, variance = drift.fall + slack, (math.sqrt(drift.variance) + slack) ** 2
    scale = 2 * horizon * variance + 2 * fall * loss / 3
    return math.exp(-(loss**2) / scale) if scale > 0 else 0.0


def _arrays(model: TransitionModel) -> tuple[Floats, AnyInts, Bools, Floats]:
    return model.prob, model.next_state, model.terminated, model.reward


@compiled
def _drift(
    prob: Floats,
    next_state: AnyInts,
    terminated: Bools,
    reward: Floats,
    reached: Bools,
    values: Floats,
) -> tuple[float, float, float]:
    """The attributes of `Drift`.

    An end counts as if the episode went on where a step at the least cost would be worth as much.
    """
    step_cost = np.inf
    for state in range(prob.shape[0]):
        if reached[state]:
            for action in range(prob.shape[1]):
                for k in range(prob.shape[2]):
                    if prob[state, action, k] > 0 and not terminated[state, action, k]:
                        step_cost = min(step_cost, -reward[state, action, k])
    fall, variance = 0.0, 0.0
    for state in range(prob.shape[0]):
        if reached[state]:
            for action in range(prob.shape[1]):
                mean, square, lowest = 0.0, 0.0, np.inf
                for k in range(prob.shape[2]):
                    if prob[state, action, k] > 0:
                        after = values[next_state[state, action, k]]
                        if terminated[state, action, k]:
                            after = reward[state, action, k] + step_cost
                        gap = after - values[state]
                        mean += prob[state, action, k] * gap
                        square += prob[state, action, k] * gap * gap
                        lowest = min(lowest, gap)
                fall = max(fall, mean - lowest)
                variance = max(variance, square - mean * mean)
    return step_cost, fall, variance
