"""Whether other rewards have the same optimal policies, and what they cost, exactly.

Shaped rewards keep the optimal policies if they are the original ones times a positive factor, plus
``discount * potential(next state) - potential(state)``, with a potential of 0 where the episode has
ended (Ng, Harada and Russell, Policy Invariance under Reward Transformations, 1999). With a time
limit the potential would have to be 0 at the cut, too (Grzes, Reward Shaping in Episodic
Reinforcement Learning, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mdp.finite_horizon import finite_horizon_optimum
from mdp.planning import Plan, policy_iteration
from mdp.transition_model import Bools, Floats, Ints, TransitionModel

# Values closer than this are equal: relative to the state's own value, and, for values near 0, to
# the largest value of all states, which is what rounding goes by.
EQUAL, EQUAL_NEAR_ZERO = 1e-9, 1e-12
# Outcomes of all states and actions, and the same times the steps of the time limit. Beyond,
# planning takes many seconds.
MOST_OUTCOMES = 2_000_000
MOST_BACKED_UP = 50_000_000


@dataclass(frozen=True, eq=False)
class Effect:
    """What shaped rewards make of the optimal policies, in one objective.

    Attributes:
        differs: the states in which the sets of optimal actions differ, bool of shape (S,). With a
            discount all states count that can be reached; under a time limit, states at the
            moments at which an optimal policy is there.
        optimal: the optimal actions in the original rewards, bool of shape (S, A); under a time
            limit with all steps left.
        shaped: the same in the shaped rewards.
        optimum: the highest expected return in the original rewards.
        best: the highest one of the policies that are optimal in the shaped rewards.
        worst: the lowest one of these.
        policy: a policy that is optimal in the original rewards, actions of shape (horizon, S). It
            does what ``worst_policy`` does wherever that is optimal.
        worst_policy: of the policies that are optimal in the shaped rewards, the one with the
            lowest original return under the time limit, of the same shape.
    """

    differs: Bools
    optimal: Bools
    shaped: Bools
    optimum: float
    best: float
    worst: float
    policy: Ints
    worst_policy: Ints

    @property
    def is_same(self) -> bool:
        """Whether the optimal policies are the same."""
        return not self.differs.any()


@dataclass(frozen=True, eq=False)
class DiscountedEffect(Effect):
    """The effect on policies that are optimal with a discount and without a time limit.

    Attributes:
        judged: the highest and the lowest undiscounted return under the time limit, in the original
            rewards, of the policies that are optimal in the shaped rewards.
        judged_before: the same of those that are optimal in the original rewards: what differs from
            the optimum under the limit here is due to the discount.
        factor: c, if the shaped rewards are c > 0 times the original ones plus the difference of a
            potential, in the mean over outcomes; else None.
        potential: that potential, shape (S,), or None.
    """

    judged: tuple[float, float]
    judged_before: tuple[float, float]
    factor: float | None
    potential: Floats | None


def check_alike(original: TransitionModel, shaped: TransitionModel, horizon: int) -> None:
    """Check that both models have the same states and actions, and are not too large.

    Raises:
        ValueError: if not.
    """
    sizes = [(model.n_states, model.n_actions) for model in (original, shaped)]
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"{sizes[1][0]:,} states and {sizes[1][1]} actions cannot be compared with "
            f"{sizes[0][0]:,} states and {sizes[0][1]} actions"
        )
    size = max(original.prob.size, shaped.prob.size)
    if size > MOST_OUTCOMES or size * horizon > MOST_BACKED_UP:
        raise ValueError(
            f"{original.n_states:,} states under a limit of {horizon:,} steps are too many to plan"
        )


def discounted_effect(
    original: TransitionModel, shaped: TransitionModel, discount: float, horizon: int
) -> DiscountedEffect:
    """Compare the policies that are optimal with a discount and without a time limit.

    Args:
        original: the decision process in which policies are judged.
        shaped: the one in which they are optimal. Its starting states do not matter; in states that
            it never reaches, every action counts as optimal.
        discount: at least 0 and below 1.
        horizon: the time limit under which returns are judged.

    Raises:
        ValueError: for a discount out of range, or as `check_alike`.
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount is {discount}, it must be at least 0 and below 1")
    check_alike(original, shaped, horizon)
    everywhere = original.reachable / original.reachable.sum()
    plan = policy_iteration(original, discount)
    shaped_plan = policy_iteration(replace(shaped, initial=everywhere), discount)
    optimal = _best(plan.action_values)
    theirs = _best(shaped_plan.action_values) | ~shaped.reachable[:, None]
    bad = replace(original, reward=-original.reward)
    judged, before = (
        (
            finite_horizon_optimum(original, horizon, mask=mask).start_value,
            0.0 - finite_horizon_optimum(bad, horizon, mask=mask).start_value,
        )
        for mask in (theirs, optimal)
    )
    worst_policy = finite_horizon_optimum(bad, horizon, mask=theirs).policy.astype(np.int64)
    is_optimal = optimal[np.arange(original.n_states), worst_policy]
    factor, potential = _potential(original, shaped, plan, shaped_plan)
    return DiscountedEffect(
        differs=original.reachable & (optimal != theirs).any(axis=1),
        optimal=optimal,
        shaped=theirs,
        optimum=plan.start_value,
        best=policy_iteration(original, discount, theirs).start_value,
        worst=0.0 - policy_iteration(bad, discount, theirs).start_value,
        policy=np.where(is_optimal, worst_policy, plan.policy),
        worst_policy=worst_policy,
        judged=judged,
        judged_before=before,
        factor=factor,
        potential=potential,
    )


def effect_under_limit(original: TransitionModel, shaped: TransitionModel, horizon: int) -> Effect:
    """Compare the policies that are optimal without a discount under a time limit.

    What is optimal depends on the steps that are left, so that the sets are compared at each step,
    in the states that an optimal policy may come to by then: two sets of optimal policies are equal
    if they are equal there.

    Args:
        original: the decision process in which policies are judged.
        shaped: the one in which they are optimal, as in `discounted_effect`.
        horizon: the time limit of both.

    Raises:
        ValueError: for a horizon below 1, or as `check_alike`.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1")
    check_alike(original, shaped, horizon)
    values = [np.zeros(original.n_states)] * 4
    rows: list[tuple[Bools, Bools, Ints, Ints]] = []
    for _ in range(horizon):
        found = [
            _action_values(model, later)
            for model, later in zip((original, shaped, original, original), values, strict=True)
        ]
        optimal, theirs = _best(found[0]), _best(found[1]) | ~shaped.reachable[:, None]
        worst_values = np.where(theirs, found[3], np.inf)
        worst_action = worst_values.argmin(axis=1)
        is_optimal = np.take_along_axis(optimal, worst_action[:, None], axis=1)[:, 0]
        action = np.where(is_optimal, worst_action, found[0].argmax(axis=1))
        rows.append((optimal, theirs, action, worst_action))
        best_values = np.where(theirs, found[2], -np.inf).max(axis=1)
        earlier = [
            found[0].max(axis=1),
            found[1].max(axis=1),
            best_values,
            worst_values.min(axis=1),
        ]
        if all(map(np.array_equal, earlier, values)):
            break
        values = earlier
    in_time = [rows[min(left, len(rows)) - 1] for left in range(horizon, 0, -1)]
    differs, here = np.zeros(original.n_states, np.bool_), original.initial > 0
    for optimal, theirs, _, _ in in_time:
        differs |= here & (optimal != theirs).any(axis=1)
        here = _following(original, here, optimal)
    return Effect(
        differs=differs,
        optimal=in_time[0][0],
        shaped=in_time[0][1],
        optimum=float(original.initial @ values[0]),
        best=float(original.initial @ values[2]),
        worst=float(original.initial @ values[3]),
        policy=np.array([row[2] for row in in_time]),
        worst_policy=np.array([row[3] for row in in_time]),
    )


def _action_values(model: TransitionModel, later: Floats) -> Floats:
    """What actions are worth without a discount, by the states' values one step later."""
    following = np.where(model.terminated, 0.0, later[model.next_state])
    return np.asarray(model.expected_reward + np.einsum("sak,sak->sa", model.prob, following))


def _best(action_values: Floats) -> Bools:
    """The best actions of each state, those that tie but for rounding, bool of shape (S, A)."""
    best = action_values.max(axis=1, keepdims=True)
    margin = np.maximum(EQUAL * np.abs(best), EQUAL_NEAR_ZERO * np.abs(action_values).max())
    return np.asarray(action_values >= best - margin)


def _following(model: TransitionModel, here: Bools, actions: Bools) -> Bools:
    """The states that the actions may lead to from some states, bool of shape (S,)."""
    goes_on = (model.prob > 0) & ~model.terminated & (here[:, None] & actions)[:, :, None]
    there = np.zeros(model.n_states, np.bool_)
    there[model.next_state[goes_on]] = True
    return there


def _potential(
    original: TransitionModel, shaped: TransitionModel, plan: Plan, shaped_plan: Plan
) -> tuple[float | None, Floats | None]:
    """The factor and the potential that make the shaped rewards of the original ones, or None.

    They exist if and only if the advantages of actions in the two optima are proportional: then the
    potential is the factor times the original's optimal values, minus those of the shaped rewards.
    The factor is found by least squares.
    """
    names = ("prob", "next_state", "terminated")
    states = original.reachable
    if original.prob.shape != shaped.prob.shape or not all(
        np.array_equal(getattr(original, name)[states], getattr(shaped, name)[states])
        for name in names
    ):
        return None, None
    ours, theirs = (
        (each.action_values - each.values[:, None])[states] for each in (plan, shaped_plan)
    )
    largest = np.abs(plan.values).max(), np.abs(shaped_plan.values).max()
    ours = np.where(np.abs(ours) > EQUAL * largest[0], ours, 0.0)  # what is left is rounding
    factor = float((ours * theirs).sum() / (ours**2).sum()) if ours.any() else 1.0
    margin = EQUAL * max(factor * largest[0], largest[1])
    if factor <= 0 or np.abs(theirs - factor * ours).max() > margin:
        return None, None
    factor = 1.0 if abs(factor - 1) < EQUAL else factor
    potential = factor * plan.values - shaped_plan.values
    potential[np.abs(potential) <= margin] = 0.0
    return factor, potential
