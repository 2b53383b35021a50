"""What a policy is worth, computed and not sampled.

For the forms that a policy may be given in see ``mdp.policies``. Only the rows of states that the
policy visits are used.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mdp.array_types import Bools, Floats
from mdp.chain import PolicyChain
from mdp.limited_episodes import LimitedEpisodes
from mdp.policies import Policy, canonical_policy, policy_matrix
from mdp.policy_returns import PolicyReturn, over_starts
from mdp.transition_model import TransitionModel


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
    if model.reward_variance is not None:
        return _with_drawn_rewards(model, policy, horizon, discount, success)
    policy = canonical_policy(model, policy, horizon)
    ends_well = model.terminated if success is None else model.terminated & success
    if horizon is not None:
        episodes = LimitedEpisodes(model, policy, horizon)
        return episodes.result(float(discount), ends_well, with_success=success is not None)
    chain = PolicyChain.build(model, policy_matrix(model, policy))
    moments = _moments_without_limit(chain, discount, ends_well)
    return over_starts(model.initial[chain.states], moments, with_success=success is not None)


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
    if horizon is not None:
        return LimitedEpisodes(model, policy, horizon).visits()
    visits = np.zeros(model.n_states)
    chain = PolicyChain.build(model, policy_matrix(model, policy))
    _refuse_endless(chain)
    visits[chain.states] = chain.solve(model.initial[chain.states], 1.0, transposed=True)
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
    _check(model, horizon, discount, None)
    best = -np.inf
    uniform, *constant = baseline_policies(model)
    # Random actions visit most, and it soon shows that they are worse, where others are known.
    for policy in (*constant, uniform):
        episodes = LimitedEpisodes(model, canonical_policy(model, policy, horizon), horizon)
        floor = best if discount == 1 else -np.inf
        found = episodes.result(discount, model.terminated, with_success=False, floor=floor)
        best = max(best, found.expected_return)
    return best


def _with_drawn_rewards(
    model: TransitionModel,
    policy: Policy,
    horizon: int | None,
    discount: float,
    success: Bools | None,
) -> PolicyReturn:
    """As `policy_return`, where rewards vary around their means independently of all else.

    That adds the expected sum of their own variances, each discounted twice, to the variance.
    """
    assert model.reward_variance is not None
    settled = replace(model, reward_variance=None)
    result = policy_return(settled, policy, horizon, discount, success)
    drawn = replace(settled, reward=model.reward_variance)
    added = policy_return(drawn, policy, horizon, discount**2).expected_return
    return replace(result, return_variance=result.return_variance + added)


def _check(
    model: TransitionModel, horizon: int | None, discount: float, success: Bools | None
) -> None:
    if horizon is not None and horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1, or None for no limit")
    if not 0 <= discount <= 1:
        raise ValueError(f"discount is {discount}, it must lie between 0 and 1")
    if success is not None and success.shape != model.prob.shape:
        raise ValueError(f"success has shape {success.shape}, the model has {model.prob.shape}")


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
