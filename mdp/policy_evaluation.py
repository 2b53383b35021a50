"""What a policy is worth, computed and not sampled.

For the forms that a policy may be given in see ``mdp.policies``. Only the rows of states that the
policy visits are used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdp.array_types import Bools, Floats, Ints
from mdp.chain import PolicyChain
from mdp.graph import reachable_states
from mdp.moments import moments_under_limit, visits_under_limit
from mdp.policies import Policy, actions_used, canonical_policy, chances_in, policy_matrix
from mdp.transition_model import TransitionModel


@dataclass(frozen=True)
class PolicyReturn:
    """Mean and variance of one episode, from the distribution of starting states.

    Attributes:
        expected_return: the mean of the (discounted) sum of rewards.
        return_variance: its variance.
        expected_length: the mean number of steps; infinite where episodes may never end.
        length_variance: its variance; NaN where the mean is infinite.
        success_rate: the probability that the episode succeeds; None where success was not defined.
    """

    expected_return: float
    return_variance: float
    expected_length: float
    length_variance: float
    success_rate: float | None

    @property
    def success_variance(self) -> float | None:
        """The variance of one episode's success, counted as 0 or 1."""
        return None if self.success_rate is None else self.success_rate * (1 - self.success_rate)


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
        horizon: the time limit in steps, after which the episode is cut off; None for none.
        discount: from 0 to 1.
        success: the outcomes that make an episode a success, bool of shape (S, A, K). They must
            end the episode: marks on others are ignored.

    Raises:
        ValueError: for arguments out of range or of the wrong shape, and, without time limit and
            discount, for a policy under which episodes may never end.
    """
    _check(model, horizon, discount, success)
    policy = canonical_policy(model, policy, horizon)
    ends_well = model.terminated if success is None else model.terminated & success
    if horizon is None:
        chain = PolicyChain.build(model, policy_matrix(model, policy))
        moments = _moments_without_limit(chain, discount, ends_well)
        start = model.initial[chain.states]
    else:
        states, prob, next_state, terminated = _visited(model, policy)
        reward, good = model.reward[states], ends_well[states]
        chances = chances_in(model, policy, states)
        rows = (prob, next_state, terminated, reward, good, chances)
        moments = moments_under_limit(*rows, horizon, float(discount))
        start = model.initial[states]
    return _over_starts(start, moments, with_success=success is not None)


def state_visitation(model: TransitionModel, policy: Policy, horizon: int | None) -> Floats:
    """The expected number of times that an episode acts in each state, shape (S,).

    Args:
        model: the decision process.
        policy: in any of its forms.
        horizon: the time limit in steps; None for none.

    Raises:
        ValueError: as ``policy_return``.
    """
    _check(model, horizon, 1.0, None)
    policy = canonical_policy(model, policy, horizon)
    visits = np.zeros(model.n_states)
    if horizon is None:
        chain = PolicyChain.build(model, policy_matrix(model, policy))
        _refuse_endless(chain)
        visits[chain.states] = chain.solve(model.initial[chain.states], 1.0, transposed=True)
    else:
        states, prob, next_state, terminated = _visited(model, policy)
        chances, start = chances_in(model, policy, states), model.initial[states]
        visits[states] = visits_under_limit(prob, next_state, terminated, chances, start, horizon)
    return visits


def baseline_policies(model: TransitionModel) -> list[Floats]:
    """The policies of agents that have learnt nothing: random first, then each constant action.

    Returns:
        Policy matrices of shape (S, A), 1 + A of them.
    """
    shape = (model.n_states, model.n_actions)
    uniform = np.full(model.n_actions, 1 / model.n_actions)
    return [np.broadcast_to(row, shape) for row in (uniform, *np.eye(model.n_actions))]


def baseline_return(model: TransitionModel, horizon: int, discount: float = 1.0) -> float:
    """The largest expected return of uniformly random actions and of each constant action.

    Random actions alone would be too low a mark: wherever mistakes cost more than time, standing
    still beats them by far. (Not the best that ignores the observation: a fixed list of actions
    does too, and may be optimal where nothing is random.)
    """
    return max(
        policy_return(model, policy, horizon, discount).expected_return
        for policy in baseline_policies(model)
    )


def _check(
    model: TransitionModel, horizon: int | None, discount: float, success: Bools | None
) -> None:
    if horizon is not None and horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1, or None for no limit")
    if not 0 <= discount <= 1:
        raise ValueError(f"discount is {discount}, it must lie between 0 and 1")
    if success is not None and success.shape != model.prob.shape:
        raise ValueError(f"success has shape {success.shape}, the model has {model.prob.shape}")


def _visited(model: TransitionModel, policy: Policy) -> tuple[Ints, Floats, Ints, Bools]:
    """The states that a policy visits, and the rows of the model for them alone.

    Returns:
        The states, shape (n,); prob, next_state (counting in those n), terminated: (n, A, K).
    """
    visited = reachable_states(model, actions_used(model, policy))
    states = np.flatnonzero(visited)
    place = np.cumsum(visited) - 1
    return states, model.prob[states], place[model.next_state[states]], model.terminated[states]


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


def _over_starts(initial: Floats, moments: Floats, *, with_success: bool) -> PolicyReturn:
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
