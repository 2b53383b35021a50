"""The best policy of a finite Markov decision process, and its values.

Without a time limit some best policy is stationary; for planning under a time limit, see
``mdp.finite_horizon``.

Without discount, the sum of rewards until the episode ends is a stochastic shortest path problem
(Bertsekas and Tsitsiklis, An Analysis of Stochastic Shortest Path Problems, 1991). It has a finite
optimum where an agent can surely end the episode, or stay for ever at no cost, and cannot earn
reward for ever.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import called, compiled
from rl_yardstick.mdp.graph import PolicyChain, end_components, steps_to_end
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, Ints, TransitionModel

# Beyond this many rounds only plain sweeps are made, which are known to converge.
ROUNDS_WITH_EVALUATION = 1000
# With a discount: rounds in which sweeps do not converge on a policy's values, times states, after
# which linear systems are solved instead. About the work of importing SciPy.
ROUGH_STATES = 100_000
# The policy then changes only to an action better by this, relative to the value: above rounding.
FINE_TIE = 1e-15
# The tolerance of ties, relative to the largest value, where no error bound is proven.
UNPROVEN_TIE = 1e-9


@dataclass(frozen=True, eq=False)
class Plan:
    """An optimal stationary policy.

    Attributes:
        values: the optimal expected (discounted) sum of rewards from each state, shape (S,); zero
            for states that cannot be reached, minus infinity for those from which no policy
            surely ends an undiscounted episode.
        action_values: the same after each first action, shape (S, A); minus infinity for
            actions that cannot be part of a finite value, zero in unreachable states.
        policy: the greedy action in each state, shape (S,): the first of those whose values
            differ from the best by less than 1e-12 of it or twice the error bound, whichever is
            more (1e-9 of the largest value where the bound is an estimate). Where a cycle at no
            cost ties with progress towards the end, the first action that makes progress.
        iterations: sweeps of value iteration, or policies that policy iteration evaluated.
        error_bound: a bound on the distance between ``values`` and the optimum. It is proven,
            rounding included, with a discount below one and where every step that cannot end the
            episode costs something. Elsewhere it is an estimate: the largest change of the last
            iteration times the policy's longest expected episode.
        start_value: the mean of ``values`` over the starting states.
    """

    values: Floats
    action_values: Floats
    policy: Ints
    iterations: int
    error_bound: float
    start_value: float


def value_iteration(
    model: TransitionModel, discount: float, tolerance: float = 1e-10, mask: Bools | None = None
) -> Plan:
    """Plan by sweeping the Bellman optimality operator over the states.

    The sweeps are Gauss-Seidel, the states nearest to the end first, and between them the greedy
    policy is evaluated roughly (modified policy iteration: Puterman, Markov Decision Processes,
    1994, section 6.5). Where sweeps evaluate it too slowly, for example if standing still is best
    until the discount has made all else worthless, its linear system is solved by an iterative
    method, with memory linear in the number of states. Plain sweeps alone decide whether values
    have converged.

    Args:
        model: the decision process; rows of unreachable states are ignored.
        discount: from 0 to 1; 1 sums rewards until the episode ends.
        tolerance: sweeping stops when the proven error bound is at most this, or when values
            change by no more than rounding.
        mask: the actions that may be taken, bool of shape (S, A), or None for all.

    Raises:
        ValueError: for a discount out of range, a mask that allows nothing in a state, or where
            the undiscounted optimum is not finite.
    """
    problem = PlanningProblem.of(model, discount, mask)
    values, policy = problem.start()
    floor = np.where(problem.part.resting, 0.0, -np.inf)
    order = problem.order
    solving = False
    change = np.inf
    iterations = rough = 0
    while True:
        # Sweeps over one policy no longer help once only rounding errors are left.
        is_rough = solving or change > 1e-13 * float(np.abs(values).max())
        if is_rough and iterations < ROUNDS_WITH_EVALUATION and not problem.part.resting.any():
            order = order[np.argsort(-values[order], kind="stable")]
            if solving:
                problem.solve(policy, order, values)
            else:
                enough = 0.1 * change
                left = problem.evaluate(model.expected_reward, policy, order, values, enough)
                rough += len(order) if left > enough else 0
                solving = discount < 1 and rough > ROUGH_STATES
        tie = FINE_TIE if solving else TIE_TOLERANCE
        rules = model.dynamics, problem.part.allowed, floor, problem.discount
        change = improve(*rules, order, values, policy, tie)
        iterations += 1
        exhausted = change <= problem.rounding(values)
        if exhausted or problem.error_bound(values, change) <= tolerance:
            return _plan(problem, values, change, iterations)


def policy_iteration(model: TransitionModel, discount: float, mask: Bools | None = None) -> Plan:
    """Plan by evaluating a policy exactly and making it greedy, until no action is better.

    The linear systems are solved directly, which suits up to some ten thousand states; above, the
    memory needed depends on the model, and ``value_iteration`` is faster. Howard, Dynamic
    Programming and Markov Processes, 1960. Arguments and errors are those of `value_iteration`.
    """
    problem = PlanningProblem.of(model, discount, mask)
    _, policy = problem.start()
    states = problem.order
    iterations = 0
    while True:
        chain = PolicyChain.build(model, np.eye(model.n_actions)[policy], problem.part.states)
        rests = None
        if problem.part.resting.any():
            # An end component of one policy that is never left has no net cost: values are zero.
            rests = end_components(model, chain.used)[0][chain.states] >= 0
        values = np.zeros(model.n_states)
        values[chain.states] = chain.solve(chain.mean(chain.reward), discount, zero=rests)
        action_values = problem.action_values(values)
        iterations += 1
        gain = np.zeros(model.n_states)
        gain[states] = action_values[states].max(axis=1) - action_values[states, policy[states]]
        # Solving a long chain loses some digits, and two equally good policies must not alternate.
        better = gain > 1e3 * problem.rounding(values)
        if not better.any():
            return _plan(problem, values, float(gain.max()), iterations)
        policy = np.where(better, action_values.argmax(axis=1), policy)


def _plan(problem: PlanningProblem, values: Floats, change: float, iterations: int) -> Plan:
    model, part = problem.model, problem.part
    action_values = problem.action_values(values)
    error_bound = problem.error_bound(values, change)
    proven = np.isfinite(error_bound)
    tie = 2 * error_bound if proven else UNPROVEN_TIE * max(1.0, float(np.abs(values).max()))
    rests = part.resting & (values <= tie)
    policy = _greedy(problem, action_values, tie, rests)
    if not proven:
        steps = problem.longest_episode(policy, rests)
        error_bound = (change + problem.rounding(values)) * steps
    values[model.reachable & ~part.states] = -np.inf
    action_values[~model.reachable] = 0.0
    start = model.initial > 0
    start_value = float(model.initial[start] @ values[start])
    return Plan(values, action_values, policy, iterations, error_bound, start_value)


def _greedy(problem: PlanningProblem, action_values: Floats, tie: float, rests: Bools) -> Ints:
    """The first best action of each state, shape (S,), that makes progress or rests."""
    model, part = problem.model, problem.part
    best = action_values.max(axis=1)
    margin = np.maximum(TIE_TOLERANCE * np.maximum(1.0, np.abs(best)), tie)
    tied = part.allowed & (action_values >= (best - margin)[:, None])
    if not part.resting.any():
        return np.asarray(tied.argmax(axis=1))
    # A cycle at no cost ties with progress: only actions that may lead nearer to the end count.
    steps, _ = steps_to_end(model, tied, rests)
    nearer = model.terminated | (steps[model.next_state] < steps[:, None, None])
    goes_on = tied & ((model.prob > 0) & nearer).any(axis=2)
    chosen = np.where(rests[:, None], part.rest_actions, goes_on)
    return np.asarray(chosen.argmax(axis=1))


# Without discount: the part with a finite optimum.

# Expected rewards are sums of products; closer to zero than this they are zero up to rounding.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class FinitePart:
    """Where the undiscounted optimum is finite; with a discount, all reachable states."""

    # The reachable states whose optimum is finite, bool of shape (S,); from all other reachable
    # states it is minus infinity.
    states: Bools
    allowed: Bools  # the actions of those states that lead to no others, bool of shape (S, A)
    resting: Bools  # the states in which an agent can stay for ever at no cost, bool of shape (S,)
    rest_actions: Bools  # the actions that do so, bool of shape (S, A)
    # A lower bound on the mean cost of steps that cannot end the episode; zero where one is free.
    step_cost: float


def finite_part(model: TransitionModel, allowed: Bools) -> FinitePart:
    """Find where the undiscounted optimum of the allowed actions is finite."""
    ends = (model.terminated & (model.prob > 0)).any(axis=2)
    endless = allowed & ~ends
    # Where every step may end the episode, any cost is valid; one of the size of the rewards makes
    # the error bound tightest.
    largest = max(1.0, float(np.abs(model.expected_reward[allowed]).max()))
    step_cost = -float(model.expected_reward[endless].max()) if endless.any() else largest
    rest_actions = np.zeros_like(allowed)
    if step_cost <= ROUNDING:
        step_cost = 0.0
        rest_actions = _rest_actions(model, endless)
    resting = np.any(rest_actions, axis=1)
    states, allowed = surely_ending(model, allowed, resting)
    lost = np.flatnonzero((model.initial > 0) & ~states)
    if lost.size:
        raise ValueError(
            f"the undiscounted optimum is not finite: from starting state {lost[0]} no policy "
            "surely ends the episode; use a discount below 1 or a time limit"
        )
    return FinitePart(states, allowed, resting, rest_actions, step_cost)


def surely_ending(model: TransitionModel, allowed: Bools, resting: Bools) -> tuple[Bools, Bools]:
    """The states from which some policy ends the episode, or comes to rest, with probability one.

    Removes states without a path there, and actions that may lead to them, until nothing changes.
    """
    while True:
        steps, _ = steps_to_end(model, allowed, resting)
        good = steps >= 0
        risky = allowed & (model.goes_on & ~good[model.next_state]).any(axis=2)
        dead = allowed & ~good[:, None]
        if not (risky | dead).any():
            return good, allowed
        allowed = allowed & ~(risky | dead)


def _rest_actions(model: TransitionModel, endless: Bools) -> Bools:
    """The actions by which an agent can stay for ever at no cost, bool of shape (S, A)."""
    component, staying = end_components(model, endless)
    reward = model.expected_reward
    scale = ROUNDING * max(1.0, float(np.abs(reward[endless]).max()))
    for label in np.unique(component[(staying & (reward > scale)).any(axis=1)]):
        inside = staying & (component == label)[:, None]
        if _largest_gain(model, inside) > -scale:
            state, action = np.argwhere(inside & (reward > scale))[0]
            raise ValueError(
                f"the undiscounted optimum is not finite: action {action} in state {state} earns "
                f"{reward[state, action]:g} and can be repeated for ever at no net cost; "
                "use a discount below 1 or a time limit"
            )
    _, resting = end_components(model, staying & (np.abs(reward) <= scale))
    return resting


def _largest_gain(model: TransitionModel, inside: Bools) -> float:
    """The largest mean reward per step of staying in an end component, by linear programming.

    Puterman, Markov Decision Processes, 1994, section 8.8: the best stationary flow.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_array, vstack

    states, actions = np.nonzero(inside)
    columns = np.arange(len(states))
    prob, following = model.prob[states, actions], model.next_state[states, actions]
    repeated = np.repeat(columns, model.n_outcomes)
    shape = (model.n_states, len(states))
    inflow = csr_array((prob.ravel(), (following.ravel(), repeated)), shape=shape)
    outflow = csr_array((np.ones(len(states)), (states, columns)), shape=shape)
    balance = (inflow - outflow)[np.unique(states)]
    flow = linprog(
        -model.expected_reward[states, actions],
        A_eq=vstack([balance, np.ones((1, len(states)))]),
        b_eq=np.append(np.zeros(balance.shape[0]), 1.0),
    )
    return float(-flow.fun)


# A planning problem.

EPSILON = float(np.finfo(np.float64).eps)
# Where ``settled`` of `policy_rows` is less than this, over-relaxation by its inverse overshoots.
LEAST_SETTLED = 0.8
SWEEPS_PER_EVALUATION = 30
# Enough for any chain that mixes; a bound that needs more sweeps is not worth waiting for.
MOST_EVALUATIONS = 10_000
# Relative, for linear systems solved between two sweeps: the next policy has another system.
ACCURACY_OF_SOLUTIONS = 1e-2
MOST_KRYLOV_STEPS = 100


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """A decision process, a discount, and the part of it where the optimum is finite."""

    model: TransitionModel
    discount: float
    part: FinitePart

    @classmethod
    def of(
        cls, model: TransitionModel, discount: float, mask: Bools | None = None
    ) -> PlanningProblem:
        """Check the discount, and that the optimum is finite."""
        if not 0 <= discount <= 1:
            raise ValueError(f"discount is {discount}, it must lie between 0 and 1")
        allowed = model.allowed_actions(mask)
        if discount == 1:
            return cls(model, float(discount), finite_part(model, allowed))
        none = np.zeros_like(allowed)
        part = FinitePart(model.reachable, allowed, np.zeros_like(model.reachable), none, 0.0)
        return cls(model, float(discount), part)

    @cached_property
    def order(self) -> Ints:
        """The states to plan for, those nearest to the end (or to rest) first."""
        steps, order = steps_to_end(self.model, self.part.allowed, self.part.resting)
        return np.concatenate([order, np.flatnonzero(self.part.states & (steps < 0))])

    def start(self) -> tuple[Floats, Ints]:
        """First values, shape (S,), and a policy, shape (S,), that surely ends or comes to rest.

        Where rest is possible the values are the policy's own: from below, sweeps converge to
        the optimum; from above, they may keep a reward that staying never collects.
        """
        part = self.part
        values = np.zeros(self.model.n_states)
        policy = part.rest_actions.argmax(axis=1)
        order = self.order[~part.resting[self.order]]
        known = part.resting.copy()
        first_guess(self.model.dynamics, part.allowed, self.discount, known, order, values, policy)
        if part.resting.any():
            reward = self.model.expected_reward
            for _ in range(MOST_EVALUATIONS):
                change = self.evaluate(reward, policy, order, values, 0.0)
                if change <= self.rounding(values):
                    break
        return values, policy

    def evaluate(
        self, reward: Floats, policy: Ints, order: Ints, values: Floats, enough: float
    ) -> float:
        """Improve the values of a policy, in place, by some sweeps over the states of ``order``.

        Other states count as terminal. Stops once values change by no more than ``enough``;
        returns the largest change of the last sweep.
        """
        model = self.model
        arrays = (model.prob, model.next_state, model.terminated, reward)
        rows = policy_rows(arrays, self.discount, order, policy)
        settled = rows[3]
        settled[settled < LEAST_SETTLED] = 1.0
        found = values[order]
        first = latest = evaluate(*rows, found)
        for _ in range(SWEEPS_PER_EVALUATION - 1):
            if latest <= enough:
                break
            latest = evaluate(*rows, found)
        if latest <= first:
            values[order] = found
        return latest

    def solve(self, policy: Ints, order: Ints, values: Floats) -> None:
        """Improve the values of a policy, in place, where ``evaluate`` would need many sweeps.

        The linear system is solved by BiCGSTAB (van der Vorst, 1992), with a sweep as
        preconditioner, to a hundredth of the residual. Needs a discount below one.
        """
        from scipy.sparse import csr_array
        from scipy.sparse.linalg import LinearOperator, bicgstab

        rows = policy_rows(self.model.dynamics, self.discount, order, policy)
        weight, following, reward, _ = rows
        n, ends = len(order), np.arange(0, weight.size + 1, weight.shape[1])
        moves = csr_array((weight.ravel(), following.ravel(), ends), shape=(n, n))
        diagonal = 1 - moves.diagonal()

        def sweep(right: Floats) -> Floats:
            found = np.zeros(n)
            evaluate(weight, following, right, diagonal, found)
            return found

        missing = reward - values[order] + moves @ values[order]
        change, _ = bicgstab(
            LinearOperator((n, n), lambda v: v - moves @ v, dtype=np.float64),
            missing,
            rtol=ACCURACY_OF_SOLUTIONS,
            maxiter=MOST_KRYLOV_STEPS,
            M=LinearOperator((n, n), sweep, dtype=np.float64),
        )
        found = values[order] + change
        if np.abs(reward - found + moves @ found).max() <= np.abs(missing).max():
            values[order] = found

    def action_values(self, values: Floats) -> Floats:
        """Values of shape (S, A), minus infinity for actions that are not allowed."""
        model = self.model
        following = np.where(model.goes_on, values[model.next_state], 0.0)
        found = model.expected_reward.copy()
        # In this order, the sums are those of the compiled sweeps, to the last bit.
        for k in range(model.n_outcomes):
            found += self.discount * model.prob[:, :, k] * following[:, :, k]
        return np.where(self.part.allowed, found, -np.inf)

    def rounding(self, values: Floats) -> float:
        """The change of a value that rounding alone may make in one sweep."""
        return 8 * EPSILON * max(1.0, float(np.abs(values[self.order]).max(initial=0.0)))

    def error_bound(self, values: Floats, change: float) -> float:
        """Bound the distance to the optimum after a sweep that changed values by ``change``.

        With discount, the operator is a contraction. Without, let each step that cannot end the
        episode cost at least c, and let M be so large that each step that may end it with
        probability p earns at most M p - c. Then (1 - e) values + e M is not raised by the
        operator, and (1 + e) values - e M not lowered, for e = change / (c - change): the
        optimum lies between. Where a step may cost nothing, no bound is known.
        """
        change += self.rounding(values)
        if self.discount < 1:
            return change / (1 - self.discount)
        cost = self.part.step_cost
        if cost <= change:
            return np.inf
        return change / (cost - change) * float(np.abs(self._ceiling - values[self.order]).max())

    @cached_property
    def _ceiling(self) -> float:
        """M of the error bound."""
        model = self.model
        ending = np.einsum("sak,sak->sa", model.prob, model.terminated)
        ends = self.part.allowed & (ending > 0)
        needed = (model.expected_reward[ends] + self.part.step_cost) / ending[ends]
        return float(needed.max(initial=0.0))

    def longest_episode(self, policy: Ints, rests: Bools) -> float:
        """The largest expected number of steps until a policy ends the episode or rests."""
        order = self.order[~rests[self.order]]
        steps = np.zeros(self.model.n_states)
        one = np.ones_like(self.model.expected_reward)
        for _ in range(MOST_EVALUATIONS):
            if self.evaluate(one, policy, order, steps, 0.0) <= 1e-6 * steps.max():
                return float(steps.max())
        return np.inf


# Sweeps over the states.

# All arrays are those of `TransitionModel`; ``mean_reward`` and ``allowed`` have shape (S, A),
# ``values`` and ``floor`` shape (S,). ``order`` lists the states to sweep, nearest to the end of
# the episode first: what a sweep finds near the end then reaches all others in the same sweep.


TIE_TOLERANCE = 1e-12


@called
def action_value(model: Dynamics, state: int, action: int, later: Floats, discount: float) -> float:
    """The value of an action, from the state values one step later."""
    prob, next_state, terminated, mean_reward = model
    value = float(mean_reward[state, action])
    for k in range(prob.shape[2]):
        if prob[state, action, k] > 0 and not terminated[state, action, k]:
            value += discount * prob[state, action, k] * later[next_state[state, action, k]]
    return value


@called
def pass_on(model: Dynamics, state: int, action: int, weight: float, there: Floats) -> float:
    """Move a state's probability to its successors in ``there``; returns the part that goes on."""
    prob, next_state, terminated, _ = model
    left = 0.0
    for k in range(prob.shape[2]):
        if prob[state, action, k] > 0 and not terminated[state, action, k]:
            there[next_state[state, action, k]] += weight * prob[state, action, k]
            left += weight * prob[state, action, k]
    return left


@compiled
def improve(
    model: Dynamics,
    allowed: Bools,
    floor: Floats,
    discount: float,
    order: Ints,
    values: Floats,
    policy: Ints,
    tie: float,
) -> float:
    """One Gauss-Seidel sweep of the Bellman optimality operator, in place.

    ``policy`` switches to the best action only where that is better by more than ``tie``, relative
    to the value where that is above 1.

    Returns:
        The largest change of a value.
    """
    prob = model[0]
    largest = 0.0
    for state in order:
        best = -np.inf
        current = -np.inf
        best_action = -1
        for action in range(prob.shape[1]):
            if not allowed[state, action]:
                continue
            value = action_value(model, state, action, values, discount)
            if value > best:
                best = value
                best_action = action
            if action == policy[state]:
                current = value
        if best > current + tie * max(1.0, abs(best)):
            policy[state] = best_action
        best = max(best, floor[state])
        largest = max(largest, abs(best - values[state]))
        values[state] = best
    return largest


@compiled
def first_guess(
    model: Dynamics,
    allowed: Bools,
    discount: float,
    known: Bools,
    order: Ints,
    values: Floats,
    policy: Ints,
) -> None:
    """First values and actions, in one pass.

    Outcomes that lead away from the end count as staying in place. Without randomness the results
    are shortest paths. With it, each action still leads nearer to the end, or to the states
    ``known`` before, with positive probability wherever it can, so that the policy ends every
    episode. ``known``, bool of shape (S,), is extended on the way.
    """
    prob, next_state, terminated, mean_reward = model
    for state in order:
        best = -np.inf
        for action in range(prob.shape[1]):
            if not allowed[state, action]:
                continue
            value = mean_reward[state, action]
            staying = 0.0
            ahead = False
            for k in range(prob.shape[2]):
                if prob[state, action, k] > 0:
                    following = next_state[state, action, k]
                    if terminated[state, action, k]:
                        ahead = True
                    elif known[following]:
                        ahead = True
                        value += discount * prob[state, action, k] * values[following]
                    else:
                        staying += discount * prob[state, action, k]
            if (ahead or discount < 1) and value / (1 - staying) > best:
                best = value / (1 - staying)
                policy[state] = action
        values[state] = best
        known[state] = True


def policy_rows(
    model: Dynamics, discount: float, order: Ints, policy: Ints
) -> tuple[Floats, NDArray[np.int32], Floats, Floats]:
    """The rows of a policy's actions in sweep order, with states as indices into that order.

    States that are not in ``order`` count as terminal.

    Returns:
        Discounted weights and indices of the following states, both (n, K); rewards (n,); and 1
        minus the weight of states at the same or a later index, (n,).
    """
    prob, next_state, terminated, mean_reward = model
    here, taken = np.arange(len(order), dtype=np.int32), order * prob.shape[1] + policy[order]
    place = np.full(len(prob), -1, np.int32)
    place[order] = here
    # Taken from flat arrays, which is twice as fast as by two indices.
    chance, reached, ends = (
        array.reshape(-1, prob.shape[2]).take(taken, axis=0)
        for array in (prob, next_state, terminated)
    )
    following = place.take(reached)
    weight = discount * chance * ~(ends | (following < 0))
    settled = np.ones(len(order))
    for k in range(weight.shape[1]):
        settled -= np.where(following[:, k] >= here, weight[:, k], 0.0)
    return weight, np.maximum(following, 0), mean_reward.take(taken), settled


@compiled
def evaluate(
    weight: Floats, following: NDArray[np.int32], reward: Floats, settled: Floats, values: Floats
) -> float:
    """One sweep of the Bellman operator of a policy over its rows, in place; the largest change.

    Each change is divided by ``settled``, as if the states swept later changed by as much
    (successive over-relaxation with a factor for each state). Without this, transitions to those
    states would hold values near their old ones.
    """
    largest = 0.0
    for place in range(len(reward)):
        value = reward[place]
        for k in range(weight.shape[1]):
            value += weight[place, k] * values[following[place, k]]
        change = (value - values[place]) / settled[place]
        values[place] += change
        largest = max(largest, abs(change))
    return largest
