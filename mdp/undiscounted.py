"""Planning without discount: which part of a decision process has a finite optimum.

The sum of rewards until the episode ends is a stochastic shortest path problem (Bertsekas and
Tsitsiklis, An Analysis of Stochastic Shortest Path Problems, 1991). It has a finite optimum where
an agent can surely bring the episode to its end, or stay for ever at no cost, and cannot earn for
ever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdp.array_types import Bools
from mdp.graph import end_components, steps_to_end
from mdp.transition_model import TransitionModel, allowed_actions

# Expected rewards are sums of products; closer to zero than this they are zero up to rounding.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class FinitePart:
    """Where the undiscounted optimum is finite.

    Attributes:
        states: the reachable states whose optimum is finite, bool of shape (S,); from all other
            reachable states it is minus infinity.
        allowed: the actions of those states that lead to no others, bool of shape (S, A).
        resting: the states in which an agent can stay for ever at no cost, bool of shape (S,).
        rest_actions: the actions that do so, bool of shape (S, A).
        step_cost: no step that cannot end the episode earns more than minus this; zero where
            some such step costs nothing.
    """

    states: Bools
    allowed: Bools
    resting: Bools
    rest_actions: Bools
    step_cost: float

    @classmethod
    def everything(cls, model: TransitionModel, mask: Bools | None = None) -> FinitePart:
        """All reachable states and their allowed actions, as with a discount below one."""
        allowed = allowed_actions(model, mask)
        none = np.zeros_like(allowed)
        return cls(model.reachable, allowed, np.zeros_like(model.reachable), none, 0.0)


def finite_part(model: TransitionModel, mask: Bools | None = None) -> FinitePart:
    """Find where the undiscounted optimum is finite.

    Args:
        model: the decision process.
        mask: the actions that may be taken, bool of shape (S, A), or None for all.

    Raises:
        ValueError: if the mask is malformed, or the optimum infinite, because an agent can earn
            for ever, or minus infinity from a starting state, because from there no policy surely
            ends the episode.
    """
    allowed = allowed_actions(model, mask)
    ends = (model.terminated & (model.prob > 0)).any(axis=2)
    endless = allowed & ~ends
    # Where every step may end the episode, any cost will do; one of the rewards' own size makes
    # the bound of the error as close as it can be.
    largest = max(1.0, float(np.abs(model.expected_reward[allowed]).max()))
    step_cost = -float(model.expected_reward[endless].max()) if endless.any() else largest
    rest_actions = np.zeros_like(allowed)
    if step_cost <= ROUNDING:
        step_cost = 0.0
        rest_actions = _rest_actions(model, endless)
    resting = np.any(rest_actions, axis=1)
    states, allowed = _surely_ending(model, allowed, resting)
    lost = np.flatnonzero((model.initial > 0) & ~states)
    if lost.size:
        raise ValueError(
            f"the undiscounted optimum is not finite: from starting state {lost[0]} no policy "
            "surely ends the episode; use a discount below 1 or a time limit"
        )
    return FinitePart(states, allowed, resting, rest_actions, step_cost)


def _surely_ending(model: TransitionModel, allowed: Bools, resting: Bools) -> tuple[Bools, Bools]:
    """The states from which some policy ends the episode, or comes to rest, with probability one.

    What has no way there is left out, and then what might lead to it, until nothing changes.
    """
    leads = (model.prob > 0) & ~model.terminated
    while True:
        steps, _ = steps_to_end(model, allowed, resting)
        good = steps >= 0
        risky = allowed & (leads & ~good[model.next_state]).any(axis=2)
        dead = allowed & ~good[:, None]
        if not (risky | dead).any():
            return good, allowed
        allowed = allowed & ~(risky | dead)


def _rest_actions(model: TransitionModel, endless: Bools) -> Bools:
    """The actions by which an agent can stay for ever at no cost, bool of shape (S, A).

    Raises:
        ValueError: if an agent can earn for ever.
    """
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
