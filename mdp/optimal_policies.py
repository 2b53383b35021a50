"""The best policy of a finite Markov decision process, and its values.

Without a time limit the best policy is stationary; for the best one under a time limit, which is
not, see ``mdp.finite_horizon``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdp.array_types import Bools, Floats, Ints
from mdp.chain import PolicyChain
from mdp.graph import end_components, steps_to_end
from mdp.problem import PlanningProblem
from mdp.sweeps import TIE_TOLERANCE, improve
from mdp.transition_model import TransitionModel

# Beyond this many rounds only plain sweeps are made, which are known to converge.
ROUNDS_WITH_EVALUATION = 1000
# With a discount, rounds in which sweeps leave a policy's values rough, times states: then linear
# systems are solved. It is about the work that SciPy's import takes.
ROUGH_STATES = 100_000
# An action has to be better by this to be taken then, relative to the value: by more than rounding.
FINE_TIE = 1e-15
# What counts as a tie, relative to the largest value, where no bound of the error is known.
UNPROVEN_TIE = 1e-9


@dataclass(frozen=True, eq=False)
class Plan:
    """An optimal stationary policy.

    Attributes:
        values: the optimal expected (discounted) sum of rewards from each state, shape (S,); zero
            for states that cannot be reached, minus infinity for those from which no policy
            surely ends an undiscounted episode.
        action_values: the same after taking each action first, shape (S, A); minus infinity for
            actions that cannot be part of a finite value, zero in unreachable states.
        policy: the greedy action in each state, shape (S,): the first of those whose values
            differ from the best by less than 1e-12 of it or twice the error bound, whichever is
            more (1e-9 of the largest value where the bound is an estimate). Where going round at
            no cost ties with going on, the first that goes on.
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
    1994, section 6.5). Where sweeps evaluate it too slowly, as where agents do best to stand still
    until the discount has made all else worth nothing, its linear system is solved by an iterative
    method, whose memory grows with the states alone. Whether values have converged is judged by
    the plain sweeps alone.

    Args:
        model: the decision process; rows of unreachable states are ignored.
        discount: from 0 to 1; 1 sums rewards until the episode ends.
        tolerance: sweeping stops when the proven error bound is at most this, and otherwise
            when values change by no more than rounding makes them.
        mask: the actions that may be taken, bool of shape (S, A), or None for all.

    Raises:
        ValueError: for a discount or tolerance out of range, a mask of another shape or that
            allows nothing in a state, or where the undiscounted optimum is not finite.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance is {tolerance}, it must be positive")
    problem = PlanningProblem.of(model, discount, mask)
    values, policy = problem.start()
    floor = np.where(problem.part.resting, 0.0, -np.inf)
    order = problem.order
    solving = False
    change = np.inf
    iterations = rough = 0
    while True:
        if _worth_evaluating(problem, values, change, iterations, solving):
            order = order[np.argsort(-values[order], kind="stable")]
            if solving:
                problem.solve(policy, order, values)
            else:
                enough = 0.1 * change
                left = problem.evaluate(model.expected_reward, policy, order, values, enough)
                rough += len(order) if left > enough else 0
                solving = discount < 1 and rough > ROUGH_STATES
        tie = FINE_TIE if solving else TIE_TOLERANCE
        rise, fall = improve(
            *problem.rows, problem.part.allowed, floor, problem.discount, order, values, policy, tie
        )
        change = max(rise, fall)
        iterations += 1
        exhausted = change <= problem.rounding(values)
        if exhausted or problem.error_bound(values, change) <= tolerance:
            return _plan(problem, values, change, iterations)


def policy_iteration(model: TransitionModel, discount: float, mask: Bools | None = None) -> Plan:
    """Plan by evaluating a policy exactly and making it greedy, until no action is better.

    The linear systems are solved directly, which suits some ten thousand states; beyond, the
    memory that this takes depends on the model, and ``value_iteration`` is faster. Howard, Dynamic
    Programming and Markov Processes, 1960.

    Args:
        model: the decision process; rows of unreachable states are ignored.
        discount: from 0 to 1; 1 sums rewards until the episode ends.
        mask: as in ``value_iteration``.

    Raises:
        ValueError: for a discount out of range, a malformed mask, or where the undiscounted
            optimum is not finite.
    """
    problem = PlanningProblem.of(model, discount, mask)
    _, policy = problem.start()
    states = problem.order
    iterations = 0
    while True:
        values = _exact_values(problem, policy)
        action_values = problem.action_values(values)
        iterations += 1
        gain = np.zeros(model.n_states)
        gain[states] = action_values[states].max(axis=1) - action_values[states, policy[states]]
        # Solving a long chain loses some digits, and two equally good policies must not alternate.
        better = gain > 1e3 * problem.rounding(values)
        if not better.any():
            return _plan(problem, values, float(gain.max()), iterations)
        policy = np.where(better, action_values.argmax(axis=1), policy)


def _worth_evaluating(
    problem: PlanningProblem, values: Floats, change: float, iterations: int, solving: bool
) -> bool:
    """Whether to evaluate the policy: by sweeps, not where only rounding is left to mend."""
    if problem.part.resting.any() or iterations >= ROUNDS_WITH_EVALUATION:
        return False
    return solving or change > 1e-13 * float(np.abs(values).max())


def _exact_values(problem: PlanningProblem, policy: Ints) -> Floats:
    model = problem.model
    taken = np.zeros((model.n_states, model.n_actions))
    taken[np.arange(model.n_states), policy] = 1.0
    chain = PolicyChain.build(model, taken, problem.part.states)
    values = np.zeros(model.n_states)
    rests = None
    if problem.part.resting.any():
        # Where a single action per state stays for ever, it does so at no cost.
        component, _ = end_components(model, chain.used)
        rests = component[chain.states] >= 0
    values[chain.states] = chain.solve(chain.mean(chain.reward), problem.discount, zero=rests)
    return values


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
    """The first best action of each state, shape (S,), that also gets somewhere."""
    model, part = problem.model, problem.part
    best = action_values.max(axis=1)
    margin = np.maximum(TIE_TOLERANCE * np.maximum(1.0, np.abs(best)), tie)
    tied = part.allowed & (action_values >= (best - margin)[:, None])
    if not part.resting.any():
        return _first(tied)
    # Going round at no cost ties with going on: only an action that may lead nearer counts.
    steps, _ = steps_to_end(model, tied, rests)
    nearer = model.terminated | (steps[model.next_state] < steps[:, None, None])
    goes_on = tied & ((model.prob > 0) & nearer).any(axis=2)
    chosen = np.where(rests[:, None], part.rest_actions, goes_on)
    return _first(chosen)


def _first(mask: Bools) -> Ints:
    """The first true column of each row."""
    first: Ints = mask.argmax(axis=1)
    return first
