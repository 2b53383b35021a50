"""What each state is worth: under a policy, and at best, with the whole time limit ahead."""

from __future__ import annotations

import numpy as np

from mdp.array_types import Bools, Floats, Ints
from mdp.finite_horizon import finite_horizon_optimum
from mdp.limited_episodes import LimitedEpisodes
from mdp.machine_code import compiled
from mdp.policies import Policy, canonical_policy, chances_in
from mdp.transition_model import TransitionModel

# Far above what a thousand steps round off, far below what a learner could tell apart.
OPTIMAL_TOLERANCE = 1e-9


def state_values(model: TransitionModel, policy: Policy, horizon: int) -> Floats:
    """The expected undiscounted return of episodes that begin in each state.

    Args:
        model: the decision process.
        policy: in any of its forms, see ``mdp.policies``.
        horizon: the time limit in steps, all of which are left in each state.

    Returns:
        Shape (S,); zero for states that no policy reaches.

    Raises:
        ValueError: for a horizon below 1, or a malformed policy.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1")
    policy = canonical_policy(model, policy, horizon)
    states = np.flatnonzero(model.reachable)
    values = np.zeros(model.n_states)
    moments = LimitedEpisodes(model, policy, horizon).along_ways(states, 1.0, model.terminated)
    if moments is not None:
        values[states] = moments[:, 0]
        return values
    place = np.cumsum(model.reachable) - 1
    values[states] = _returns_under_limit(
        model.prob[states],
        place[model.next_state[states]],
        model.terminated[states],
        model.expected_reward[states],
        chances_in(model, policy, states),
        horizon,
    )
    return values


def optimal_choices(model: TransitionModel, horizon: int) -> tuple[Floats, Bools]:
    """The best that can be made of each state, and all the actions that begin it.

    Sutton and Barto, Reinforcement Learning, 2nd edition, section 3.6.

    Args:
        model: the decision process.
        horizon: the time limit in steps, all of which are left in each state.

    Returns:
        The optimal expected undiscounted returns, shape (S,), zero for states that no policy
        reaches. And the actions whose value comes within 1e-9 of the best, relative to it where
        it is above 1: bool of shape (S, A), all of them where nothing is reached.

    Raises:
        ValueError: for a horizon below 1.
    """
    values = finite_horizon_optimum(model, horizon).values
    later = finite_horizon_optimum(model, horizon - 1).values if horizon > 1 else 0 * values
    following = np.where(model.terminated, 0.0, later[model.next_state])
    action_values = model.expected_reward + np.einsum("sak,sak->sa", model.prob, following)
    margin = OPTIMAL_TOLERANCE * np.maximum(1.0, np.abs(values))
    optimal = action_values >= (values - margin)[:, None]
    return values, optimal | ~model.reachable[:, None]


@compiled
def _returns_under_limit(
    prob: Floats,
    next_state: Ints,
    terminated: Bools,
    mean_reward: Floats,
    policy: Floats,
    horizon: int,
) -> Floats:
    """The mean alone of what ``mdp.moments.moments_under_limit`` gives, shape (n,)."""
    later = np.zeros(prob.shape[0])
    now = np.zeros(prob.shape[0])
    for step in range(horizon - 1, -1, -1):
        chances = policy[min(step, policy.shape[0] - 1)]
        changed = False
        for state in range(prob.shape[0]):
            value = 0.0
            for action in range(prob.shape[1]):
                if chances[state, action] > 0:
                    after = mean_reward[state, action]
                    for k in range(prob.shape[2]):
                        if prob[state, action, k] > 0 and not terminated[state, action, k]:
                            after += prob[state, action, k] * later[next_state[state, action, k]]
                    value += chances[state, action] * after
            changed = changed or value != later[state]
            now[state] = value
        now, later = later, now
        # One more step has changed nothing: nor will any further one.
        if not changed and policy.shape[0] == 1:
            break
    return later
