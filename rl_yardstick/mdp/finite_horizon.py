"""The optimal policy under a time limit, and faster methods for large maps under one.

- The optimum under a limit too distant to matter, from planning without a limit.
- Forward evaluation of a policy: the distribution of states, step by step. On large state spaces
  few states have positive probability at any one step; backward induction would update every
  reachable state at every step.
- Evaluation without randomness, by doubling. The return of 2 n steps from a state is that of n
  steps, plus that of n steps from the state they lead to: a time limit of T takes log2(T) rounds
  over the states, however often an episode goes round in circles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import compiled, inlined, kernel
from rl_yardstick.mdp.planning import TIE_TOLERANCE, action_value, value_iteration
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, Ints, TransitionModel

# A distant limit.

# Backwards from a limit of T steps, planning takes T sweeps over all states. Where every step costs
# something, the optimum without the limit nearly always equals it to the last digits; the result is
# used only where that is proved.
#
# Let V be the optimal values without the limit, let -c be the lowest of them, and let no step that
# goes on earn more than -e. A step by an optimal action raises V by e or more, in the mean. An
# agent that is still under way after T steps has reached max V at most, and so has lost at least
# B = T e - (max V - V(start)) to chance or to actions that are not optimal. The limit spares it c
# at most: to lose c by its actions is no gain. So the limit raises the return by at most c times
# the probability that chance alone takes the rest, x = B - c. The loss by chance is a sum of T
# terms of mean zero, which by Bernstein's inequality for martingales (Freedman, On Tail
# Probabilities for Martingales, 1975) reaches x with a probability of at most
# exp(-x^2 / (2 T v + 2 b x / 3)), where v is the largest variance of a term and b its largest fall.
#
# The limit lowers the return by no more: the policy that is optimal without the limit is under way
# after T steps with an even smaller probability, and could then earn at most max V more.


# The largest error accepted, relative to the optimum where that is above 1.
TOLERANCE = 1e-9


def optimum_far_from_limit(model: TransitionModel, horizon: int) -> float | None:
    """The highest expected return under a distant time limit, from planning without a limit.

    Args:
        model: the decision process.
        horizon: the time limit in steps.

    Returns:
        The mean over the starting states, within 1e-9 of it (relative, where it is above 1), the
        error bound of planning included. None where this accuracy cannot be proved, for example
        because the limit is near or steps cost nothing.
    """
    if not (model.terminated & (model.prob > 0)).any():
        return None  # a task that never ends, which takes longest to plan
    try:
        plan = value_iteration(model, 1.0)
    except ValueError:
        return None  # without a limit there is no finite optimum
    values = plan.values[model.reachable]
    if not (np.isfinite(values).all() and np.isfinite(plan.error_bound)):
        return None
    lowest_start = float(plan.values[model.initial > 0].min())
    highest, lowest = max(float(values.max()), 0.0), min(float(values.min()), 0.0)
    step_cost, fall, variance = drift(model, plan.values)
    slack = 4 * plan.error_bound  # error of differences of values, each within the bound
    overdue = horizon * step_cost - (highest - lowest_start) - slack
    loss, fall, deviation = overdue + lowest - slack, fall + slack, math.sqrt(variance) + slack
    chance = 1.0
    if step_cost > 0 and loss > 0:
        scale = 2 * horizon * deviation**2 + 2 * fall * loss / 3
        chance = math.exp(-(loss**2) / scale) if scale > 0 else 0.0
    error = plan.error_bound + max(-lowest, highest) * chance
    return plan.start_value if error <= TOLERANCE * max(1.0, abs(plan.start_value)) else None


def drift(model: TransitionModel, values: Floats) -> tuple[float, float, float]:
    """How a step changes the value: the worst cases over all reachable states and actions.

    Returns the least cost of a step that goes on, the largest fall of the value below its mean in a
    step, and the largest variance of the value after a step. An end with reward r counts as a step
    of least cost e to a state of value r + e.
    """
    states = np.flatnonzero(model.reachable)
    prob, terminated, reward = model.prob[states], model.terminated[states], model.reward[states]
    going = reward[model.goes_on[states]]
    step_cost = -float(going.max()) if going.size else 0.0
    after = np.where(terminated, reward + step_cost, values[model.next_state[states]])
    gap = np.where(prob > 0, after - values[states, None, None], np.inf)
    lowest = gap.min(axis=2)
    gap[prob == 0] = 0.0
    mean, square = (prob * gap).sum(axis=2), (prob * gap**2).sum(axis=2)
    fall, variance = (mean - lowest).max(), (square - mean**2).max()
    return step_cost, max(float(fall), 0.0), max(float(variance), 0.0)


# Spreading.

Rows = tuple[Floats, NDArray[np.integer], Bools, Floats, Bools]

# Upper bound on the total probability that is ignored, in states that are unlikely at a step:
# reached if all states were ignored at all steps.
SHARE_LEFT_OUT = 1e-15


def moments_by_spreading(
    rows: Rows,
    policy: Floats,
    initial: Floats,
    horizon: int,
    discount: float,
    floor: float = -np.inf,
) -> Floats:
    """Mean and variance of the return, of the length, and the probability of success.

    Episodes in the same state at the same step form a group: its probability, the mean of its
    returns so far, and their sum of squared deviations, which stays accurate where the mean is
    large.

    Args:
        rows: prob, next_state, terminated, reward of `TransitionModel`, and the outcomes that count
            as success; all of shape (S, A, K).
        policy: the probabilities of the actions, shape (S, A).
        initial: probabilities of the starting states, shape (S,).
        horizon: the time limit in steps.
        discount: from 0 to 1.
        floor: give up once the mean return is certainly below this. Must be minus infinity
            (never) where there is a discount.

    Returns:
        Shape (5,); a mean return of minus infinity if evaluation gave up.
    """
    n_states = len(initial)
    now, later = np.zeros((n_states, 3)), np.zeros((n_states, 3))
    now[:, 0] = initial
    here, there = np.zeros(n_states, np.int64), np.zeros(n_states, np.int64)
    starts = np.flatnonzero(initial)
    here[: len(starts)] = starts
    over = np.zeros((3, 3))
    least = SHARE_LEFT_OUT / (n_states * horizon)  # the least probability of a state at a step
    prob, _, terminated, reward, _ = rows
    best_end = float(reward[(prob > 0) & terminated].max(initial=-np.inf))
    best_step = float(reward[(prob > 0) & ~terminated].max(initial=-np.inf))
    limits = best_end, best_step
    groups = now, later, here, there
    if not _follow(
        rows, policy, groups, len(starts), over, horizon, discount, least, limits, floor
    ):
        return np.array([-np.inf, *[np.nan] * 4])
    (ended, mean, spread), (_, length, length_spread), (good, _, _) = over.tolist()
    return np.array([mean, spread / ended, length, length_spread / ended, good])


@kernel
def _follow(
    rows: Rows,
    policy: Floats,
    groups: tuple[Floats, Floats, Ints, Ints],
    n_here: int,
    over: Floats,
    horizon: int,
    discount: float,
    least: float,
    limits: tuple[float, float],
    floor: float,
) -> bool:
    """Follow the episodes from step to step; False where their mean return is below the floor.

    ``groups`` holds the groups of each state now and one step later, both (S, 3), and the lists of
    states that have one, both (S,), in any order, ``n_here`` of them at the beginning. ``over``,
    shape (3, 3), holds the episodes that are over: a group of returns, a group of lengths, and the
    probability of success. States less likely than ``least`` are ignored. ``limits`` are the
    highest rewards of a step that ends the episode and of one that does not.
    """
    now, later, here, there = groups
    best_end, best_step = limits
    factor = 1.0
    for step in range(horizon):
        n_there, before = 0, over[0, 0]
        hope = over[0, 0] * over[0, 1]
        left, on_the_way = horizon - step, max(best_step, 0.0) * (horizon - step - 1)
        unfinished = best_step * left if best_step > -np.inf else -np.inf
        to_come = max(best_end + on_the_way, unfinished)  # the most that the next steps may earn
        for i in range(n_here):
            state = here[i]
            hope += now[state, 0] * (now[state, 1] + to_come)
            if now[state, 0] >= least:
                is_last = step == horizon - 1
                n_there = _spread(
                    rows, policy, state, now, factor, is_last, later, there, n_there, over
                )
            now[state, 0] = now[state, 1] = now[state, 2] = 0.0
        if hope < floor:
            return False
        _merge(over, 1, over[0, 0] - before, step + 1.0, 0.0)
        now, later = later, now
        here, there = there, here
        n_here = n_there
        factor *= discount
        if n_here == 0:
            break
    return True


@inlined
def _spread(
    rows: Rows,
    policy: Floats,
    state: int,
    now: Floats,
    factor: float,
    is_last: bool,
    later: Floats,
    there: Ints,
    n_there: int,
    over: Floats,
) -> int:
    """Let the group of one state take a step; returns the number of states in ``there``."""
    prob, next_state, terminated, reward, success = rows
    at, mean, variance = now[state, 0], now[state, 1], now[state, 2] / now[state, 0]
    for action in range(prob.shape[1]):
        if policy[state, action] == 0:
            continue
        for k in range(prob.shape[2]):
            chance = at * policy[state, action] * prob[state, action, k]
            if chance == 0:
                continue
            result = mean + factor * reward[state, action, k]
            if terminated[state, action, k] or is_last:
                _merge(over, 0, chance, result, variance * chance)
                is_good = terminated[state, action, k] and success[state, action, k]
                over[2, 0] += chance * is_good
                continue
            place = next_state[state, action, k]
            if later[place, 0] == 0:
                there[n_there] = place
                n_there += 1
            _merge(later, place, chance, result, variance * chance)
    return n_there


@inlined
def _merge(groups: Floats, place: int, chance: float, mean: float, spread: float) -> None:
    """Add episodes to a group: their probability, mean, and sum of squared deviations.

    Chan, Golub and LeVeque, Updating Formulae and a Pairwise Algorithm, 1979.
    """
    if chance > 0:
        total = groups[place, 0] + chance
        gap = mean - groups[place, 1]
        share = chance / total
        groups[place, 2] += spread + gap * gap * groups[place, 0] * share
        groups[place, 1] += gap * share
        groups[place, 0] = total


# Deterministic episodes.

# The result of some number of steps from each state, arrays of shape (n + 1,), the last entry for
# the ended episode: the (discounted) sum of rewards, the number of steps until then or the end,
# whether the episode has succeeded, and the state reached.
Ways = tuple[Floats, Floats, Bools, Ints]


def walked(step: Ways, horizon: int, discount: float) -> Ways:
    """The result of ``horizon`` steps from each state, from that of one, by doubling."""
    n = len(step[0])
    total = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_), np.arange(n)
    n_done, n_steps = 0, 1
    while True:
        if horizon & n_steps:
            total = _followed(total, step, discount**n_done)
            n_done += n_steps
        if n_done == horizon:
            return total
        step = _followed(step, step, discount**n_steps)
        n_steps *= 2


def _followed(first: Ways, then: Ways, discount: float) -> Ways:
    """The steps of ``first``, then those of ``then`` with rewards multiplied by ``discount``."""
    reward, length, success, place = first
    return (
        reward + discount * then[0][place],
        length + then[1][place],
        success | then[2][place],
        then[3][place],
    )


# The smallest unsigned integers that hold the actions.
Actions = NDArray[np.unsignedinteger]


@dataclass(frozen=True, eq=False)
class FiniteHorizonPlan:
    """An optimal policy under a time limit."""

    #: The optimal expected (discounted) sum of rewards from each state at step 0, shape (S,); zero
    #: for states that cannot be reached.
    values: Floats
    #: The greedy action, the first among ties within 1e-12 of the best value, with 1, 2, ... steps
    #: left: shape (m, S). With more than m steps left, the last row applies.
    actions_left: Actions
    horizon: int  #: the number of steps after which the episode is cut off
    start_value: float  #: the mean of ``values`` over the starting states

    @property
    def policy(self) -> Actions:
        """The actions at each step, shape (horizon, S), in order of time."""
        left = np.minimum(np.arange(self.horizon, 0, -1), len(self.actions_left))
        rows: Actions = self.actions_left[left - 1]
        return rows


def finite_horizon_optimum(
    model: TransitionModel, horizon: int, discount: float = 1.0, mask: Bools | None = None
) -> FiniteHorizonPlan:
    """Plan backwards from the time limit.

    Sutton and Barto, Reinforcement Learning, 2nd edition, chapter 4; Puterman, Markov
    Decision Processes, 1994, section 4.5.

    Arguments and errors are those of `mdp.planning.value_iteration`, and ``horizon``, the time
    limit in steps, at least 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1")
    if not 0 <= discount <= 1:
        raise ValueError(f"discount is {discount}, it must lie between 0 and 1")
    rows: list[Actions] = []
    values = np.zeros(model.n_states)
    for earlier, actions in backwards(model, horizon, discount, mask):
        values = earlier
        rows.append(actions)
    return FiniteHorizonPlan(values, np.array(rows), horizon, float(model.initial @ values))


def backwards(
    model: TransitionModel, horizon: int, discount: float = 1.0, mask: Bools | None = None
) -> Iterator[tuple[Floats, Actions]]:
    """Optimal values and actions with 1, 2, ... steps left, each of shape (S,).

    Stops once a step changes no value in its last bit: further steps would change none either.
    """
    states, allowed = np.flatnonzero(model.reachable), model.allowed_actions(mask)
    later = np.zeros(model.n_states)
    for _ in range(horizon):
        values = np.zeros(model.n_states)
        actions = np.zeros(model.n_states, np.min_scalar_type(model.n_actions - 1))
        back_up(model.dynamics, allowed, float(discount), states, later, values, actions)
        yield values, actions
        if np.array_equal(values, later):
            return
        later = values


@compiled
def back_up(
    model: Dynamics,
    allowed: Bools,
    discount: float,
    states: Ints,
    values: Floats,
    earlier: Floats,
    actions: Actions,
) -> None:
    """Values one step earlier, and the actions to take there, into ``earlier`` and ``actions``."""
    prob = model[0]
    action_values = np.empty(prob.shape[1])
    for state in states:
        # A loop: NumPy's maximum takes longer to compile than all of this.
        best = -np.inf
        for action in range(prob.shape[1]):
            if not allowed[state, action]:
                action_values[action] = -np.inf
                continue
            value = action_value(model, state, action, values, discount)
            action_values[action] = value
            best = max(best, value)
        tied = best - TIE_TOLERANCE * max(1.0, abs(best))
        action = 0
        while action_values[action] < tied:
            action += 1
        earlier[state] = best
        actions[state] = action
