"""Exact discounted values and advantages of a policy, and the exact expectation of GAE estimates.

There is no time limit: agents bootstrap where one cuts an episode off, so their estimates do not
depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rl_yardstick.mdp.graph import PolicyChain
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

# Without discount, an episode surely ends if its probability of ending is within this of one.
SURELY = 1e-9
SETTLED = 1e-14


@dataclass(frozen=True, eq=False)
class PolicyValues:
    """The values of a stationary policy.

    Attributes:
        values: state values V(s), shape (S,).
        action_values: action values Q(s, a), shape (S, A).
        advantages: Q(s, a) - V(s), shape (S, A).

    All are NaN in unreachable states, and, without discount, where the episode may never end.
    """

    values: Floats
    action_values: Floats

    @property
    def advantages(self) -> Floats:
        """Action values minus state values."""
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
    goes_on = (model.prob > 0) & ~model.terminated
    following = np.where(goes_on, values[model.next_state], 0.0)
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
