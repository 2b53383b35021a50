"""The optimum over memoryless policies, where several states look alike.

A memoryless policy depends on the current observation alone. The best one is hard to find
(Littman, Memoryless Policies: Theoretical Limitations and Practical Results, 1994), and may have to
be stochastic. Gradient ascent from several starts finds a policy. All deterministic policies are
tried; where they are too many, those that the ascents lead to are improved by hill climbing over
changes of the action at one observation. Branch and bound over boxes of policies (each probability
between two bounds) then bounds the return of all others, in two ways: by an agent that observes the
state and chooses from the box anew at each step, and by bounds on the derivatives of the return in
each probability. Smaller boxes give closer bounds; with few observations and actions they meet the
return that was found.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from functools import partial
from itertools import count, cycle
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import called, compiled
from rl_yardstick.mdp.evaluation import policy_return
from rl_yardstick.mdp.gaps import policy_gradient
from rl_yardstick.mdp.planning import action_value
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, Ints, TransitionModel

# Limits for a search of some seconds. Work is in outcomes and choices of all states at all steps.
MOST_OUTCOMES_CLIMBED = 100_000_000  # for one return; above, there is no search
# For all returns of the ascents, again for those of the bounds, and of deterministic policies.
MOST_WORK = 100_000_000
RANDOM_STARTS = 4
MOST_RETURNS = 100_000  # for the bounds
MOST_FIRM = 100_000  # deterministic policies; up to this number, all are tried
# Logit of an almost deterministic policy; ascents start from half of it.
STEEP = 6.0
# Bounds within this of the return found, relative to it, count as meeting it.
PROVED = 1e-6
ROUNDING = 1e-12  # of probabilities


class BestMemoryless(NamedTuple):
    """The best memoryless policy found, and an upper bound on all of them."""

    lower: float  # the return of `policy`
    upper: float  # no memoryless policy returns more; ``lower`` where proved within 1e-6
    policy: Floats  # probabilities of actions, by observation, shape (G, A)
    firm: float  # the highest return of the deterministic policies tried
    is_firm_known: bool  # whether all deterministic policies were tried

    @property
    def needs_chance(self) -> bool:
        """Whether a stochastic policy was found that beats all deterministic ones tried."""
        return self.lower > self.firm + 10 * PROVED * max(1.0, abs(self.firm))


def observation_groups(observations: NDArray[np.generic], reachable: Bools) -> Ints | None:
    """The index of each state's observation, shape (S,); None if observations identify states.

    Args:
        observations: the observation of each state, states along the first axis.
        reachable: the states that count, bool of shape (S,).
    """
    if observations.ndim == 1 and np.array_equal(observations, np.arange(len(observations))):
        return None
    rows = np.ascontiguousarray(observations.reshape(len(observations), -1))
    as_bytes = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, numbers = np.unique(as_bytes, return_inverse=True)
    groups: Ints = numbers.reshape(-1).astype(np.int64)
    there = groups[reachable]
    return None if len(np.unique(there)) == len(there) else groups


def best_memoryless(
    model: TransitionModel, groups: Ints, horizon: int, most: float = np.inf
) -> BestMemoryless | None:
    """The best policy that depends on the group of a state alone, and a bound on all.

    Args:
        model: the decision process.
        groups: the index of each state's observation, from 0 on, shape (S,).
        horizon: the time limit in steps.
        most: a known upper bound on the return.

    Returns None where the search would take too long.
    """
    from scipy.optimize import minimize
    from scipy.special import softmax

    states = np.flatnonzero(model.reachable)
    size = len(states) * model.n_actions * (model.n_outcomes + model.n_actions) * horizon
    if size > MOST_OUTCOMES_CLIMBED:
        return None
    n_groups, n_actions = int(groups.max()) + 1, model.n_actions
    n_calls = max(int(MOST_WORK / size), 10)
    found = _Best(model, groups, horizon)

    def downhill(flat: Floats) -> tuple[float, Floats]:
        logits = flat.reshape(n_groups, n_actions)
        shares = softmax(logits, axis=1)
        value, slope = policy_gradient(model, shares[groups], horizon)
        by_group = np.zeros((n_groups, n_actions))
        np.add.at(by_group, groups, slope)
        mean = (shares * by_group).sum(axis=1, keepdims=True)
        return -value, -(shares * (by_group - mean)).ravel()

    seen = np.unique(groups[states])
    returns = partial(_firm_returns, model.dynamics, model.initial, states, groups, horizon)
    n_firm, per_firm = n_actions ** len(seen), len(states) * model.n_outcomes * horizon
    is_firm_known = n_firm <= MOST_FIRM and n_firm * per_firm <= MOST_WORK
    firm, ends = -np.inf, []
    if is_firm_known:
        choices = np.zeros((n_firm, n_groups), np.int64)
        choices[:, seen] = np.indices((n_actions,) * len(seen)).reshape(len(seen), n_firm).T
        firm = found.take(np.eye(n_actions)[choices[returns(choices).argmax()]])
    rng = np.random.default_rng(0)
    starts = [np.zeros((n_groups, n_actions))]
    starts += [np.tile(STEEP * row, (n_groups, 1)) / 2 for row in np.eye(n_actions)]
    starts += [rng.normal(size=(n_groups, n_actions)) for _ in range(RANDOM_STARTS)]
    for start in starts:
        if found.value >= most - PROVED * max(1.0, abs(most)) or n_calls <= 0:
            break
        most_calls = {"maxfun": n_calls}
        end = minimize(downhill, start.ravel(), jac=True, method="L-BFGS-B", options=most_calls)
        n_calls -= int(end.nfev)
        logits = end.x.reshape(n_groups, n_actions)
        found.take(softmax(logits, axis=1))
        ends.append(logits.argmax(axis=1))
    most_returns = MOST_WORK // per_firm // max(len(ends), 1)
    for end in () if is_firm_known else ends:
        top = _hill_top(returns, end, seen, n_actions, most_returns)
        firm = max(firm, found.take(np.eye(n_actions)[top]))
    work = min(MOST_RETURNS, int(MOST_WORK / size))
    upper = min(most, _bound_of_all(found, seen, horizon, work))
    if upper <= found.value + PROVED * max(1.0, abs(found.value)):
        upper = found.value
    return BestMemoryless(found.value, upper, found.policy, firm, is_firm_known)


class _Best:
    """The best policy found so far."""

    def __init__(self, model: TransitionModel, groups: Ints, horizon: int) -> None:
        self.model, self.groups, self.horizon = model, groups, horizon
        self.value, self.policy = -np.inf, np.zeros((0, 0))

    def take(self, policy: Floats) -> float:
        """Return the value of a policy, shape (G, A), and keep the policy if it is the best."""
        value = policy_return(self.model, policy[self.groups], self.horizon).expected_return
        if value > self.value:
            self.value, self.policy = value, policy
        return value


def _hill_top(
    returns: Callable[[Ints], Floats], actions: Ints, seen: Ints, n_actions: int, most_returns: int
) -> Ints:
    """Change the action at one observation (G,) after another, until no change is better."""
    best, unchanged = -np.inf, 0
    for group in cycle(seen):
        choices = np.tile(actions, (n_actions, 1))
        choices[:, group] = np.arange(n_actions)
        values = returns(choices)
        unchanged += 1
        if values.max() > best:
            best, actions, unchanged = values.max(), choices[values.argmax()], 0
        most_returns -= n_actions
        if unchanged == len(seen) or most_returns <= 0:
            break
    return actions


def _bound_of_all(found: _Best, seen: Ints, horizon: int, work: int) -> float:
    """A return that no memoryless policy exceeds, from branch and bound."""
    model = found.model
    enough = found.value + PROVED * max(1.0, abs(found.value))
    states: Ints = np.flatnonzero(model.reachable)
    shape, groups = found.policy.shape, found.groups
    order = count()  # breaks ties, so that arrays are never compared
    heap: list[tuple[float, int, Floats, Floats]] = []
    n_slopes, nothing = 2 * len(seen) * shape[1], np.zeros((1, model.n_states))

    def add(low: Floats, high: Floats, most: float) -> None:
        nonlocal work
        box = states, low[groups], high[groups]
        values = _returns_in_box(model.dynamics, *box, nothing, horizon)
        most = min(most, float(model.initial @ values))
        work -= 1
        if most > enough and work >= n_slopes:
            most = min(most, _bound_by_slopes(found, states, seen, low, high, horizon))
            work -= n_slopes
        heapq.heappush(heap, (-most, next(order), low, high))

    add(np.zeros(shape), np.ones(shape), np.inf)
    while work > 0 and -heap[0][0] > enough:
        bound, _, low, high = heapq.heappop(heap)
        width = (high - low)[seen]
        row, action = np.unravel_index(width.argmax(), width.shape)
        group = seen[row]
        middle = (low[group, action] + high[group, action]) / 2
        for part in (0, 1):
            lower, upper = low.copy(), high.copy()
            (upper if part == 0 else lower)[group, action] = middle
            # Probabilities sum to one, so each bound limits the others.
            upper[group] = np.minimum(upper[group], 1 - lower[group].sum() + lower[group])
            lower[group] = np.maximum(lower[group], 1 - upper[group].sum() + upper[group])
            if (lower[group] <= upper[group] + ROUNDING).all():
                add(lower, upper, -bound)
    return -heap[0][0]


def _bound_by_slopes(
    found: _Best, states: Ints, seen: Ints, low: Floats, high: Floats, horizon: int
) -> float:
    """An upper bound on the return in a box, from one of its policies and bounds on derivatives.

    Another policy is better by a sum over observations and actions: the difference of the two
    probabilities, times the first policy's advantages summed over the other's expected visits
    (Kakade and Langford, 2002). An agent that sees the state bounds that sum from both sides.
    """
    model, groups = found.model, found.groups
    middle = _inside(low, high)
    policy = middle[groups]
    values, advantages = _advantages(model.dynamics, states, policy, horizon)
    bound = float(model.initial @ values)
    free = (*model.dynamics[:3], np.zeros_like(model.expected_reward))  # without rewards
    box = states, low[groups], high[groups]
    for group in seen:
        for action in range(model.n_actions):
            more = np.where(groups == group, advantages[:, :, action], 0.0)
            up, down = (
                float(model.initial @ _returns_in_box(free, *box, each, horizon))
                for each in (more, -more)
            )
            rises, falls = (high - middle)[group, action], (middle - low)[group, action]
            bound += max(float(rises * up), float(falls * down), 0.0)
    return bound


def _inside(low: Floats, high: Floats) -> Floats:
    """A policy of the box, deterministic where the box holds one."""
    room = (high - low).sum(axis=1, keepdims=True)
    left = 1 - low.sum(axis=1, keepdims=True)
    policy: Floats = low + (high - low) * np.divide(
        left, room, out=np.zeros_like(room), where=room > 0
    )
    firm = high >= 1
    rows = np.flatnonzero(firm.any(axis=1))
    policy[rows] = np.eye(low.shape[1])[np.where(firm, low, -1.0)[rows].argmax(axis=1)]
    return policy


@compiled
def _returns_in_box(
    model: Dynamics, states: Ints, low: Floats, high: Floats, extra: Floats, horizon: int
) -> Floats:
    """The returns (S,) of an agent that sees the state and chooses within the box at each step.

    The box has shape (S, A). It receives ``extra`` (1 or horizon, S), at each step in each state.
    """
    prob = model[0]
    later, now = np.zeros(prob.shape[0]), np.zeros(prob.shape[0])
    values, is_used = np.zeros(prob.shape[1]), np.zeros(prob.shape[1], np.bool_)
    for step in range(horizon - 1, -1, -1):
        changed = False
        for state in states:
            for action in range(prob.shape[1]):
                values[action] = action_value(model, state, action, later, 1.0)
            now[state] = _best_in_box(values, low[state], high[state], is_used)
            now[state] += extra[min(step, len(extra) - 1), state]
            changed = changed or now[state] != later[state]
        now, later = later, now
        if not changed and len(extra) == 1:
            break
    return later


@compiled
def _firm_returns(
    model: Dynamics, initial: Floats, states: Ints, groups: Ints, horizon: int, choices: Ints
) -> Floats:
    """The returns (P,) of deterministic policies, as actions by observation (P, G)."""
    prob = model[0]
    returns, later, now = np.zeros(len(choices)), np.zeros(prob.shape[0]), np.zeros(prob.shape[0])
    for row in range(len(choices)):
        later[:] = 0.0
        for _ in range(horizon):
            changed = False
            for state in states:
                action = choices[row, groups[state]]
                value = action_value(model, state, action, later, 1.0)
                changed = changed or value != later[state]
                now[state] = value
            now, later = later, now
            if not changed:
                break
        for state in states:
            returns[row] += initial[state] * later[state]
    return returns


@compiled
def _advantages(
    model: Dynamics, states: Ints, policy: Floats, horizon: int
) -> tuple[Floats, Floats]:
    """The returns (S,) of a policy (S, A), and its advantages (horizon, S, A)."""
    n_states, n_actions = policy.shape
    advantages, values = np.zeros((horizon, n_states, n_actions)), np.zeros(n_actions)
    later, now = np.zeros(n_states), np.zeros(n_states)
    for step in range(horizon - 1, -1, -1):
        for state in states:
            now[state] = 0.0
            for action in range(n_actions):
                values[action] = action_value(model, state, action, later, 1.0)
                now[state] += policy[state, action] * values[action]
            for action in range(n_actions):
                advantages[step, state, action] = values[action] - now[state]
        now, later = later, now
    return later, advantages


@called
def _best_in_box(values: Floats, low: Floats, high: Floats, is_used: Bools) -> float:
    """The highest mean of values under the probabilities of a box."""
    total, left = 0.0, 1.0
    for action in range(len(values)):
        is_used[action] = False
        total += low[action] * values[action]
        left -= low[action]
    # The rest goes to the best action, as much as the box allows, then to the next best.
    for _ in range(len(values)):
        best = -1
        for action in range(len(values)):
            if not is_used[action] and (best < 0 or values[action] > values[best]):
                best = action
        is_used[best] = True
        more = max(min(high[best] - low[best], left), 0.0)
        total += more * values[best]
        left -= more
    return total
