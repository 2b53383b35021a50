"""What the actions of a policy lose against the optimum and gain on its own values, exactly.

Under a time limit, the gap to the optimum is a sum over states and steps: the probability of being
in the state at that step, times what the policy's action loses there against the best one (the
performance difference lemma: Kakade and Langford, Approximately Optimal Approximate Reinforcement
Learning, 2002, lemma 6.1, here with time). Arguments are those of `mdp.evaluation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rl_yardstick.machine_code.compiling import compiled
from rl_yardstick.mdp.evaluation import Policy, canonical_policy, chances_in, policy_return
from rl_yardstick.mdp.finite_horizon import backwards
from rl_yardstick.mdp.graph import PolicyChain
from rl_yardstick.mdp.planning import action_value, pass_on
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, Ints, TransitionModel

# The largest number of values to store over all steps, 8 bytes each.
MOST_VALUES = 30_000_000
# The number of states to try a repair in, those with the largest losses first; and the outcomes
# of all states at all steps above which trying takes too long.
MOST_CANDIDATES = 24
MOST_OUTCOMES_REPAIRED = 20_000_000
# Probabilities of two policies within this of each other count as equal.
SAME = 1e-9


@dataclass(frozen=True, eq=False)
class GapByState:
    """The gap between the optimum and a policy, split over the states in which it acts."""

    optimum: float  #: the highest expected return under the time limit
    value: float  #: the policy's expected return
    #: The return lost in each state per episode, shape (S,). Losses are at least 0, and sum to
    #: ``optimum - value`` up to rounding.
    losses: Floats
    visits: Floats  #: how often an episode acts in each state, shape (S,)
    #: The optimal action values, averaged over the steps at which the policy is in the state, shape
    #: (S, A); 0 in states that the policy never visits.
    action_values: Floats

    @property
    def gap(self) -> float:
        """How far the policy stays behind the optimum."""
        return self.optimum - self.value


def gap_by_state(model: TransitionModel, policy: Policy, horizon: int) -> GapByState:
    """Split the gap of a policy over the states in which it acts.

    Raises:
        ValueError: for a malformed policy, and where horizon times states are too many.
    """
    policy = canonical_policy(model, policy)
    best = _optimal_rows(model, horizon)
    chances = chances_in(model, policy, np.arange(model.n_states))
    none = np.zeros(model.n_states, np.bool_)
    losses, visits, values = _losses(
        model.dynamics, chances, none, best[:1], model.initial, best, horizon
    )
    seen = visits > 0
    values[seen] /= visits[seen, None]
    value = policy_return(model, policy, horizon).expected_return
    return GapByState(float(model.initial @ best[-1]), value, losses, visits, values)


class Repair(NamedTuple):
    """A state in which to act optimally, and the policy's return after that change."""

    state: int
    value: float  # expected return with this and all earlier repairs


def greedy_repairs(
    model: TransitionModel, policy: Policy, horizon: int, split: GapByState, most: int = 3
) -> list[Repair]:
    """The states in which better actions would raise the return most, one after the other.

    In a repaired state the policy takes the best action at each step, given its actions in all
    other states. Each repair is the best among those in the states with the largest losses. The
    list is empty where the model is so large that trying repairs takes many seconds.

    Args:
        model: the decision process.
        policy: in any of its forms.
        horizon: the time limit in steps.
        split: the result of `gap_by_state` for this policy.
        most: the largest number of repairs.
    """
    if model.prob.size * horizon > MOST_OUTCOMES_REPAIRED:
        return []
    policy = canonical_policy(model, policy)
    chances = chances_in(model, policy, np.arange(model.n_states))
    best = _optimal_rows(model, horizon)
    repaired = np.zeros(model.n_states, np.bool_)
    repairs: list[Repair] = []
    losses, value = split.losses, split.value
    least = 1e-9 * max(1.0, abs(split.gap))  # smaller gains are rounding errors
    while len(repairs) < most and split.optimum - value > least:
        worst = np.argsort(-losses, kind="stable")[:MOST_CANDIDATES]
        tried: list[Repair] = []
        for state in worst[(losses[worst] > 0) & ~repaired[worst]]:
            one = repaired | (np.arange(model.n_states) == state)
            rows = _policy_rows(model.dynamics, chances, one, horizon)
            tried.append(Repair(int(state), float(model.initial @ rows[-1])))
        found = max(tried, key=lambda repair: repair.value, default=Repair(-1, value))
        if found.value <= value + least:
            break
        repairs.append(found)
        value, repaired[found.state] = found.value, True
        rows = _policy_rows(model.dynamics, chances, repaired, horizon)
        losses = _losses(model.dynamics, chances, repaired, rows, model.initial, best, horizon)[0]
    return repairs


@dataclass(frozen=True, eq=False)
class FirstDifferences:
    """Where two policies first differ in an episode, and how that changes the return."""

    met: Floats  #: the probability that an episode's first difference is in each state, shape (S,)
    #: What the first policy gains over the second by these differences, in return per episode,
    #: shape (S,). They sum to the difference of the two returns.
    gains: Floats


def first_differences(
    model: TransitionModel, policy: Policy, other: Policy, horizon: int
) -> FirstDifferences:
    """Split the difference of two policies' returns over the states where they first part.

    Raises:
        ValueError: as `gap_by_state`.
    """
    _check_size(horizon + 1, model)
    states, none = np.arange(model.n_states), np.zeros(model.n_states, np.bool_)
    chances = chances_in(model, canonical_policy(model, policy), states)
    others = chances_in(model, canonical_policy(model, other), states)
    rows = _policy_rows(model.dynamics, chances, none, horizon)
    other_rows = _policy_rows(model.dynamics, others, none, horizon)
    met, gains = np.zeros(model.n_states), np.zeros(model.n_states)
    here: Floats = model.initial
    reached = model.next_state[model.goes_on]
    for step in range(horizon):
        taken, other = (each[min(step, len(each) - 1)] for each in (chances, others))
        now, other_now = (each[min(horizon - step, len(each) - 1)] for each in (rows, other_rows))
        parting = np.where((np.abs(taken - other) > SAME).any(axis=1), here, 0.0)
        met += parting
        gains += parting * (now - other_now)
        flow = ((here - parting)[:, None] * taken)[:, :, None] * model.prob
        here = np.bincount(reached, flow[model.goes_on], model.n_states).astype(np.float64)
        if not here.any():
            break
    return FirstDifferences(met, gains)


def policy_gradient(model: TransitionModel, policy: Floats, horizon: int) -> tuple[float, Floats]:
    """The return of a stationary policy (S, A), and its gradient in the action probabilities.

    Sutton, McAllester, Singh and Mansour, Policy Gradient Methods for Reinforcement Learning with
    Function Approximation, 2000, theorem 1.

    Returns:
        The expected return, and its partial derivative with respect to each probability, shape
        (S, A).
    """
    none = np.zeros(model.n_states, np.bool_)
    rows = _policy_rows(model.dynamics, policy[None], none, horizon)
    slope = _losses(model.dynamics, policy[None], none, rows, model.initial, rows, horizon)[2]
    return float(model.initial @ rows[-1]), slope


def _check_size(n_rows: int, model: TransitionModel) -> None:
    if n_rows * model.n_states > MOST_VALUES:
        raise ValueError(
            f"the values of {model.n_states:,} states at {n_rows:,} steps and more are too many to "
            "keep"
        )


def _optimal_rows(model: TransitionModel, horizon: int) -> Floats:
    """Optimal values with 0, 1, 2, ... steps left, shape (m, S).

    With m steps or more left they are those of the last row.
    """
    rows = [np.zeros(model.n_states)]
    for values, _ in backwards(model, horizon):
        rows.append(values)
        _check_size(len(rows), model)
    return np.array(rows)


# Exact discounted values and advantages of a policy, and the exact expectation of GAE estimates.
#
# There is no time limit: agents bootstrap where one cuts an episode off, so their estimates do not
# depend on it.

# Without discount, an episode surely ends if its probability of ending is within this of one.
SURELY = 1e-9
SETTLED = 1e-14


@dataclass(frozen=True, eq=False)
class PolicyValues:
    """The values of a stationary policy.

    All are NaN in unreachable states, and, without discount, where the episode may never end.
    """

    values: Floats  #: state values V(s), shape (S,)
    action_values: Floats  #: action values Q(s, a), shape (S, A)

    @property
    def advantages(self) -> Floats:
        """Q(s, a) - V(s), shape (S, A)."""
        return self.action_values - self.values[:, None]


def discounted_values(model: TransitionModel, policy: Floats, discount: float) -> PolicyValues:
    """The exact values of a policy matrix (S, A), without time limit."""
    chain = PolicyChain.build(model, policy, model.reachable)
    unknown = np.zeros(chain.size, np.bool_)
    if discount == 1:
        ends = chain.solve(chain.mean(chain.terminated), 1.0, zero=chain.endless)
        unknown = ends < 1 - SURELY
    values = np.full(model.n_states, np.nan)
    found = chain.solve(chain.mean(chain.reward), discount, zero=unknown)
    values[chain.states] = np.where(unknown, np.nan, found)
    action_values = model.expected_reward + discount * expected_next(model, values)
    return PolicyValues(values, np.where(model.reachable[:, None], action_values, np.nan))


def expected_next(model: TransitionModel, values: Floats) -> Floats:
    """Expected value of the state after each action, shape (S, A); 0 after termination."""
    following = np.where(model.goes_on, values[model.next_state], 0.0)
    mean: Floats = np.einsum("sak,sak->sa", model.prob, following)
    return mean


def expected_estimates(
    model: TransitionModel,
    policy: Floats,
    critic: Floats,
    discount: float,
    trace: float,
    steps: tuple[Ints, Ints, Ints],
) -> tuple[Floats, Floats]:
    """The exact expectation of generalised advantage estimates (GAE).

    An estimate is the sum of the TD errors of a critic from the step on, discounted by ``discount``
    times ``trace``, until the episode ends or is cut off (Schulman, Moritz, Levine, Jordan and
    Abbeel, High-Dimensional Continuous Control Using Generalized Advantage Estimation, 2016).

    Args:
        model: the decision process.
        policy: action probabilities of the policy that takes the steps, shape (S, A).
        critic: the critic's state values, shape (S,); unreachable states are ignored.
        discount: gamma.
        trace: lambda.
        steps: the states and the actions of N steps, and how many TD errors each estimate sums,
            all of shape (N,).

    Returns:
        The expectation of each estimate given its state and action, shape (N,), and given its
        state alone, shape (N,).
    """
    chain = PolicyChain.build(model, policy, model.reachable)
    leads = ~chain.terminated
    row, following = chain.row[leads], chain.following[leads]
    weight = discount * trace * chain.weight[leads]
    values = np.where(model.reachable, critic, 0.0)
    errors = model.expected_reward + discount * expected_next(model, values) - values[:, None]
    of_policy = (policy * errors)[chain.states].sum(axis=1)
    place = np.cumsum(model.reachable) - 1
    states, actions, n_left = steps
    order = np.argsort(n_left, kind="stable")
    bounds = np.searchsorted(n_left[order], np.arange(int(n_left.max(initial=0)) + 2))
    given_action, given_state = np.empty(len(states)), np.empty(len(states))
    later = np.zeros(chain.size)  # expected estimate of each state, with one TD error fewer
    for n in range(1, len(bounds) - 1):
        now = of_policy + np.bincount(row, weight * later[following], chain.size)
        # Converged: more TD errors change only the last digits.
        is_settled = np.abs(now - later).max() <= SETTLED * max(1.0, np.abs(now).max())
        here = order[bounds[n] : None if is_settled else bounds[n + 1]]
        if len(here):
            at = states[here], actions[here]
            goes_on = model.prob[at] * ~model.terminated[at]
            ahead = (goes_on * later[place[model.next_state[at]]]).sum(axis=1)
            given_action[here] = errors[at] + discount * trace * ahead
            given_state[here] = now[place[states[here]]]
        if is_settled:
            break
        later = now
    return given_action, given_state


# Compiled. With more steps left than there are rows of values, the last row applies.


@compiled
def _losses(
    model: Dynamics,
    chances: Floats,
    repaired: Bools,
    rows: Floats,
    initial: Floats,
    best: Floats,
    horizon: int,
) -> tuple[Floats, Floats, Floats]:
    """Losses (S,), visits (S,) and summed action values (S, A) of a policy (1 or horizon, S, A).

    In repaired states the policy is greedy for its own values, ``rows``.
    """
    n_states, n_actions = model[3].shape
    losses, visits = np.zeros(n_states), np.zeros(n_states)
    values, weights = np.zeros((n_states, n_actions)), np.zeros(n_actions)
    here = initial.copy()
    for step in range(horizon):
        left = horizon - step
        now, later = best[min(left, len(best) - 1)], best[min(left - 1, len(best) - 1)]
        own = rows[min(left - 1, len(rows) - 1)]
        there = np.zeros(n_states)
        goes_on = 0.0
        for state in range(n_states):
            if here[state] == 0:
                continue
            weights[:] = chances[min(step, len(chances) - 1), state]
            if repaired[state]:
                chosen, highest = 0, -np.inf
                for action in range(n_actions):
                    value = action_value(model, state, action, own, 1.0)
                    if value > highest:
                        chosen, highest = action, value
                weights[:] = 0.0
                weights[chosen] = 1.0
            visits[state] += here[state]
            for action in range(n_actions):
                value = action_value(model, state, action, later, 1.0)
                values[state, action] += here[state] * value
                weight = here[state] * weights[action]
                if weight > 0:
                    losses[state] += weight * max(now[state] - value, 0.0)
                    goes_on += pass_on(model, state, action, weight, there)
        here = there
        if goes_on == 0:
            break
    return losses, visits, values


@compiled
def _policy_rows(model: Dynamics, chances: Floats, repaired: Bools, horizon: int) -> Floats:
    """Values with 0, 1, ... steps left, shape (m, S); repaired states take the best action."""
    n_states, n_actions = model[3].shape
    rows = np.zeros((horizon + 1, n_states))
    for left in range(1, horizon + 1):
        later, now = rows[left - 1], rows[left]
        taken = chances[min(horizon - left, len(chances) - 1)]
        changed = False
        for state in range(n_states):
            highest, mean = -np.inf, 0.0
            for action in range(n_actions):
                if taken[state, action] == 0 and not repaired[state]:
                    continue
                value = action_value(model, state, action, later, 1.0)
                highest = max(highest, value)
                mean += taken[state, action] * value
            now[state] = highest if repaired[state] else mean
            changed = changed or now[state] != later[state]
        # Converged: further steps change nothing.
        if not changed and len(chances) == 1:
            return rows[: left + 1].copy()
    return rows
