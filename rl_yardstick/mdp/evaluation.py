"""Exact evaluation of policies, without sampling.

``model`` is the decision process, ``horizon`` the time limit in steps, and ``policy`` has one of
three forms. Only the rows of states that it visits are used.

- Float of shape (S, A): the probabilities of the actions in each state.
- Integer of shape (S,): the action in each state.
- Integer of shape (horizon, S): the action at each step in each state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import called, compiled
from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum, moments_by_spreading, walked
from rl_yardstick.mdp.graph import PolicyChain
from rl_yardstick.mdp.planning import action_value, pass_on
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, Ints, TransitionModel


@dataclass(frozen=True)
class PolicyReturn:
    """Moments of one episode, averaged over the distribution of starting states."""

    expected_return: float  #: the mean of the (discounted) sum of rewards
    return_variance: float  #: its variance
    expected_length: float  #: the mean number of steps; infinite where episodes may never end
    length_variance: float  #: its variance; NaN where the mean is infinite
    success_rate: float | None  #: probability of success; None where success was not defined


def over_starts(initial: Floats, moments: Floats, *, with_success: bool) -> PolicyReturn:
    """Average over the starting states; their differences add to the variances."""
    start = initial > 0
    chance, moments = initial[start], moments[start]
    mean = chance @ moments
    return PolicyReturn(
        expected_return=float(mean[0]),
        return_variance=float(mean[1] + chance @ (moments[:, 0] - mean[0]) ** 2),
        expected_length=float(mean[2]),
        length_variance=float(mean[3] + chance @ (moments[:, 2] - mean[2]) ** 2)
        if np.isfinite(mean[2])
        else float("nan"),
        success_rate=float(mean[4]) if with_success else None,
    )


def policy_return(
    model: TransitionModel,
    policy: Policy,
    horizon: int | None,
    discount: float = 1.0,
    success: Bools | None = None,
) -> PolicyReturn:
    """Evaluate a policy exactly.

    Args:
        model: the decision process.
        policy: in any of its forms.
        horizon: the time limit, after which the episode is cut off; None for none.
        discount: from 0 to 1.
        success: the outcomes that make an episode a success, bool of shape (S, A, K). Outcomes
            that do not end the episode are ignored.

    Raises:
        ValueError: for arguments out of range or of the wrong shape, and, without time limit and
            discount, for a policy under which episodes may never end.
    """
    _check(horizon, discount)
    if model.reward_variance is not None:
        # Independent random rewards around the model's means add the expected sum of their
        # variances, discounted by ``discount**2``, to the variance.
        settled = replace(model, reward_variance=None)
        result = policy_return(settled, policy, horizon, discount, success)
        drawn = replace(settled, reward=model.reward_variance)
        added = policy_return(drawn, policy, horizon, discount**2).expected_return
        return replace(result, return_variance=result.return_variance + added)
    policy = canonical_policy(model, policy)
    ends_well = model.terminated if success is None else model.terminated & success
    if horizon is not None:
        episodes = LimitedEpisodes(model, policy, horizon)
        return episodes.result(float(discount), ends_well, with_success=success is not None)
    chain = PolicyChain.build(model, policy_matrix(model, policy))
    moments = _moments_without_limit(chain, discount, ends_well)
    return over_starts(model.initial[chain.states], moments, with_success=success is not None)


def state_visitation(model: TransitionModel, policy: Policy, horizon: int | None) -> Floats:
    """The expected number of times that an episode acts in each state, shape (S,).

    There is no time limit if ``horizon`` is None. Errors are those of `policy_return`.
    """
    _check(horizon, 1.0)
    policy = canonical_policy(model, policy)
    if horizon is not None:
        return LimitedEpisodes(model, policy, horizon).visits()
    visits = np.zeros(model.n_states)
    chain = PolicyChain.build(model, policy_matrix(model, policy))
    _refuse_endless(chain)
    visits[chain.states] = chain.solve(model.initial[chain.states], 1.0, transposed=True)
    return visits


def last_visits(model: TransitionModel, policy: Policy, horizon: int, n_last: int) -> Floats:
    """Expected visits to each state in the last steps before the limit, shape (S,)."""
    visits = state_visitation(model, policy, horizon)
    if n_last < horizon:
        visits = visits - state_visitation(model, policy, horizon - n_last)
    return np.maximum(visits, 0.0)


def baseline_policies(model: TransitionModel) -> list[Floats]:
    """The matrices (S, A) of policies without learning: random first, then each constant action."""
    shape = (model.n_states, model.n_actions)
    uniform = np.full(model.n_actions, 1 / model.n_actions)
    return [np.broadcast_to(row, shape) for row in (uniform, *np.eye(model.n_actions))]


def baseline_return(model: TransitionModel, horizon: int, discount: float = 1.0) -> float:
    """The largest expected return of uniformly random actions and of each constant action.

    Random actions alone would be too easy to beat: where mistakes cost more than time, standing
    still beats them by far. (A fixed sequence of actions ignores observations too, but may be
    optimal where nothing is random.)
    """
    _check(horizon, discount)
    best = -np.inf
    uniform, *constant = baseline_policies(model)
    # Random actions visit most states: with a known floor, their evaluation often stops early.
    for policy in (*constant, uniform):
        episodes = LimitedEpisodes(model, canonical_policy(model, policy), horizon)
        floor = best if discount == 1 else -np.inf
        found = episodes.result(discount, model.terminated, with_success=False, floor=floor)
        best = max(best, found.expected_return)
    return best


def _check(horizon: int | None, discount: float) -> None:
    if horizon is not None and horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1, or None for no limit")
    if not 0 <= discount <= 1:
        raise ValueError(f"discount is {discount}, it must lie between 0 and 1")


def _moments_without_limit(chain: PolicyChain, discount: float, ends_well: Bools) -> Floats:
    """As ``moments_under_limit``, from linear systems."""
    if discount == 1:
        _refuse_endless(chain)
    moments = np.empty((len(chain.states), 5))
    moments[:, 0] = chain.solve(chain.mean(chain.reward), discount)
    result = chain.reward + discount * chain.after(moments[:, 0])
    moments[:, 1] = chain.solve(chain.spread(result, moments[:, 0]), discount**2)
    if chain.endless.any():
        moments[:, 2], moments[:, 3] = np.inf, np.nan
    else:
        moments[:, 2] = chain.solve(np.ones(len(chain.states)), 1.0)
        length = 1 + chain.after(moments[:, 2])
        moments[:, 3] = chain.solve(chain.spread(length, moments[:, 2]), 1.0)
    succeeds = chain.mean(ends_well.ravel()[chain.outcome])
    moments[:, 4] = chain.solve(succeeds, 1.0, zero=chain.endless)
    return moments


def _refuse_endless(chain: PolicyChain) -> None:
    if chain.endless.any():
        state = chain.states[chain.endless][0]
        raise ValueError(
            f"from state {state} the policy never ends the episode: give a time limit (horizon) "
            "or a discount below 1"
        )


# Far above the rounding errors of a thousand steps, far below what a learner can distinguish.
OPTIMAL_TOLERANCE = 1e-9


def state_values(model: TransitionModel, policy: Policy, horizon: int) -> Floats:
    """The expected undiscounted return of episodes that begin in each state, shape (S,).

    All steps are left there. Zero for states that no policy reaches.
    """
    policy = canonical_policy(model, policy)
    states = np.flatnonzero(model.reachable)
    values = np.zeros(model.n_states)
    episodes = LimitedEpisodes(model, policy, horizon)
    moments = episodes.along_ways(states, 1.0, model.terminated)
    if moments is not None:
        values[states] = moments[:, 0]
    else:
        chances = chances_in(model, policy, states)
        values[states] = _returns_under_limit(episodes.rows(states), chances, horizon)
    return values


def optimal_choices(model: TransitionModel, horizon: int) -> tuple[Floats, Bools]:
    """The optimal value of each state, and its optimal actions, with all steps left.

    Sutton and Barto, Reinforcement Learning, 2nd edition, section 3.6.

    Returns:
        The optimal expected undiscounted returns, shape (S,), zero for states that no policy
        reaches. And the actions whose value comes within 1e-9 of the best, relative to it where
        it is above 1: bool of shape (S, A), all actions in unreachable states.
    """
    values = finite_horizon_optimum(model, horizon).values
    later = finite_horizon_optimum(model, horizon - 1).values if horizon > 1 else 0 * values
    action_values = model.action_values(later)
    margin = OPTIMAL_TOLERANCE * np.maximum(1.0, np.abs(values))
    optimal = action_values >= (values - margin)[:, None]
    return values, optimal | ~model.reachable[:, None]


@compiled
def _returns_under_limit(model: Dynamics, policy: Floats, horizon: int) -> Floats:
    """The expected returns alone, as in ``moments_under_limit``, shape (n,)."""
    prob = model[0]
    later = np.zeros(prob.shape[0])
    now = np.zeros(prob.shape[0])
    for step in range(horizon - 1, -1, -1):
        chances = policy[min(step, policy.shape[0] - 1)]
        changed = False
        for state in range(prob.shape[0]):
            value = 0.0
            for action in range(prob.shape[1]):
                if chances[state, action] > 0:
                    after = action_value(model, state, action, later, 1.0)
                    value += chances[state, action] * after
            changed = changed or value != later[state]
            now[state] = value
        now, later = later, now
        # Converged: further steps change nothing.
        if not changed and policy.shape[0] == 1:
            break
    return later


# The forms of a policy.

Policy = NDArray[np.floating] | NDArray[np.integer]

# Networks work in float32, whose probabilities sum to one within some 1e-7.
POLICY_TOLERANCE = 1e-5


def canonical_policy(model: TransitionModel, policy: Policy) -> Policy:
    """The policy as a float64 matrix (S, A), or as actions of shape (horizon, S)."""
    if np.issubdtype(policy.dtype, np.integer):
        actions: NDArray[np.integer] = np.atleast_2d(policy)
        taken = actions[:, model.reachable]
        if taken.min() < 0 or taken.max() >= model.n_actions:
            raise ValueError(f"the policy takes an action outside 0..{model.n_actions - 1}")
        if len(actions) > 1:
            return actions
        stationary: Floats = np.eye(model.n_actions)[np.clip(actions[0], 0, model.n_actions - 1)]
        return stationary
    matrix = policy.astype(np.float64)
    total = matrix.sum(axis=1)
    # Written so that a NaN fails.
    valid = (matrix >= 0).all(axis=1) & (np.abs(total - 1) <= POLICY_TOLERANCE)
    if not valid[model.reachable].all():
        state = np.flatnonzero(model.reachable & ~valid)[0]
        raise ValueError(f"in state {state} the policy's probabilities are {policy[state]}")
    matrix[valid] /= total[valid, None]
    return matrix


def chances_in(model: TransitionModel, policy: Policy, states: Ints) -> Floats:
    """The probabilities of actions in the listed states, shape (1 or horizon, n, A)."""
    if np.issubdtype(policy.dtype, np.integer):
        return np.eye(model.n_actions)[policy[:, states]]
    return np.ascontiguousarray(policy[None, states], np.float64)


def policy_matrix(model: TransitionModel, policy: Policy) -> Floats:
    """The probabilities of actions in all states, shape (S, A), of a stationary policy."""
    matrix: Floats = chances_in(model, policy, np.arange(model.n_states))[0]
    return matrix


def actions_used(model: TransitionModel, policy: Policy) -> Bools:
    """The actions that the policy may take at some step, bool of shape (S, A)."""
    if not np.issubdtype(policy.dtype, np.integer):
        return policy > 0
    used = np.zeros((model.n_states, model.n_actions), np.bool_)
    used[np.arange(model.n_states), np.clip(policy, 0, model.n_actions - 1)] = True
    return used


# Under a time limit.

# Visited states times steps; above this, backward induction takes more than tenths of a second.
MOST_BACKWARDS = 2_000_000


@dataclass(frozen=True, eq=False)
class LimitedEpisodes:
    """The episodes of a policy under a time limit."""

    model: TransitionModel  # the decision process
    policy: Policy  # in the form of `canonical_policy`
    horizon: int  # the time limit in steps

    def result(
        self, discount: float, ends_well: Bools, *, with_success: bool, floor: float = -np.inf
    ) -> PolicyReturn:
        """Mean and variance of one episode.

        A mean return that is certainly below ``floor`` may be given as minus infinity; only
        without discount.
        """
        model, states = self.model, self._visited()
        moments = self.along_ways(states, discount, ends_well)
        is_large = len(states) * self.horizon > MOST_BACKWARDS
        if moments is None and is_large and not np.issubdtype(self.policy.dtype, np.integer):
            rows = model.prob, model.next_state, model.terminated, model.reward, ends_well
            start = self.policy.astype(np.float64), model.initial
            found = moments_by_spreading(rows, *start, self.horizon, discount, floor)
            mean, variance, length, spread, rate = found.tolist()
            return PolicyReturn(mean, variance, length, spread, rate if with_success else None)
        if moments is None:
            arrays = (*self.rows(states)[:3], model.reward[states], ends_well[states])
            chances = chances_in(self.model, self.policy, states)
            if len(chances) == 1 and ((chances == 0) | (chances == 1)).all():
                # Keep the rows of these actions only: the sweeps would skip all others each time.
                taken = np.arange(len(states)), chances[0].argmax(axis=1)
                arrays = tuple(array[taken][:, None] for array in arrays)
                chances = np.ones((1, len(states), 1))
            moments = moments_under_limit(arrays[:4], arrays[4], chances, self.horizon, discount)
        return over_starts(model.initial[states], moments, with_success=with_success)

    def visits(self) -> Floats:
        """The expected number of times that an episode acts in each state, shape (S,)."""
        states, visits = self._visited(), np.zeros(self.model.n_states)
        chances = chances_in(self.model, self.policy, states)
        start = self.model.initial[states]
        visits[states] = visits_under_limit(self.rows(states), chances, start, self.horizon)
        return visits

    def _visited(self) -> Ints:
        return np.flatnonzero(self.model.reached_by(actions_used(self.model, self.policy)))

    def rows(self, states: Ints) -> Dynamics:
        """The dynamics of n states, whose next states are indices into these n states."""
        prob, next_state, terminated, expected_reward = self.model.dynamics
        following = self._places(states)[next_state[states]]
        return prob[states], following, terminated[states], expected_reward[states]

    def _places(self, states: Ints) -> Ints:
        place = np.full(self.model.n_states, -1)
        place[states] = np.arange(len(states))
        return place

    def along_ways(self, states: Ints, discount: float, ends_well: Bools) -> Floats | None:
        """The moments, if each of the n states has one outcome; None if a state has more.

        The states must be closed under the policy; shape (n, 5) as `moments_under_limit`.
        """
        if np.issubdtype(self.policy.dtype, np.integer):
            return None
        action = self.policy[states].argmax(axis=1)
        at = states, action, self.model.prob[states, action].argmax(axis=1)
        if (self.policy[states, action] != 1).any() or (self.model.prob[at] != 1).any():
            return None
        moments, n = np.zeros((len(states), 5)), len(states)
        following = self._places(states)[self.model.next_state[at]]
        step = (
            np.append(self.model.reward[at], 0.0),
            np.append(np.ones(n), 0.0),
            np.append(ends_well[at], False),
            np.append(np.where(self.model.terminated[at], n, following), n),
        )
        total = walked(step, self.horizon, discount)
        for place, part in zip((0, 2, 4), total[:3], strict=True):
            moments[:, place] = part[:-1]
        return moments


# Compiled.


@compiled
def moments_under_limit(
    model: Dynamics, success: Bools, policy: Floats, horizon: int, discount: float
) -> Floats:
    """Moments of the episodes that start in each state.

    The variances are sums of squared deviations, which stay accurate where the mean is large
    (Sobel, The Variance of Discounted Markov Decision Processes, 1982).

    Returns:
        Shape (n, 5): mean and variance of the return, mean and variance of the length, and the
        probability of success.
    """
    prob, next_state, terminated, reward = model
    later = np.zeros((prob.shape[0], 5))
    now = np.zeros((prob.shape[0], 5))
    for step in range(horizon - 1, -1, -1):
        chances = policy[min(step, policy.shape[0] - 1)]
        changed = False
        for state in range(prob.shape[0]):
            outcomes = (prob[state], next_state[state], terminated[state], reward[state])
            _moments(outcomes, success[state], chances[state], discount, later, now[state])
            for moment in range(5):
                changed = changed or now[state, moment] != later[state, moment]
        now, later = later, now
        # Converged: further steps change nothing.
        if not changed and policy.shape[0] == 1:
            break
    return later


@called
def _moments(
    model: Dynamics, success: Bools, chances: Floats, discount: float, later: Floats, now: Floats
) -> None:
    """The moments of one state, from its rows of the model and the moments one step later."""
    prob, next_state, terminated, reward = model
    now[:] = 0.0
    now[2] = 1.0
    for action in range(prob.shape[0]):
        for k in range(prob.shape[1]):
            weight = chances[action] * prob[action, k]
            if weight > 0:
                now[0] += weight * reward[action, k]
                now[4] += weight * success[action, k]
                if not terminated[action, k]:
                    after = later[next_state[action, k]]
                    now[0] += weight * discount * after[0]
                    now[2] += weight * after[2]
                    now[4] += weight * after[4]
    # The law of total variance.
    for action in range(prob.shape[0]):
        for k in range(prob.shape[1]):
            weight = chances[action] * prob[action, k]
            if weight > 0:
                result = reward[action, k]
                length = 1.0
                if not terminated[action, k]:
                    after = later[next_state[action, k]]
                    result += discount * after[0]
                    length += after[2]
                    now[1] += weight * discount * discount * after[1]
                    now[3] += weight * after[3]
                now[1] += weight * (result - now[0]) ** 2
                now[3] += weight * (length - now[2]) ** 2


@compiled
def visits_under_limit(model: Dynamics, policy: Floats, initial: Floats, horizon: int) -> Floats:
    """The expected number of steps taken in each state, shape (n,)."""
    visits = np.zeros(len(initial))
    here = initial.copy()
    for step in range(horizon):
        chances = policy[min(step, policy.shape[0] - 1)]
        there = np.zeros(len(initial))
        left = 0.0
        for state in range(len(initial)):
            visits[state] += here[state]
            if here[state] == 0:
                continue
            for action in range(chances.shape[1]):
                weight = here[state] * chances[state, action]
                if weight > 0:
                    left += pass_on(model, state, action, weight, there)
        here = there
        if left == 0:
            break
    return visits
