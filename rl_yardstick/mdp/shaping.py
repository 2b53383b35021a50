"""Whether shaped rewards keep the optimal policies, and what return they cost otherwise, exactly.

Shaped rewards keep the optimal policies if they are the original ones times a positive factor, plus
``discount * potential(next state) - potential(state)``, with a potential of 0 where the episode has
ended (Ng, Harada and Russell, Policy Invariance under Reward Transformations, 1999). With a time
limit the potential would have to be 0 at the cut, too (Grzes, Reward Shaping in Episodic
Reinforcement Learning, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum
from rl_yardstick.mdp.planning import Plan, policy_iteration
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints, TransitionModel

# Values closer than this count as equal: relative to the state's best value or, for values near 0,
# to the largest value of all states, which sets the size of rounding errors.
EQUAL, EQUAL_NEAR_ZERO = 1e-9, 1e-12
# Outcomes of all states and actions, and the same times the steps of the time limit. Above these,
# planning takes many seconds.
MOST_OUTCOMES = 2_000_000
MOST_BACKED_UP = 50_000_000

Ends = tuple[float, float]  # the highest and the lowest return of several policies


@dataclass(frozen=True, eq=False)
class Effect:
    """How shaped rewards change the optimal policies, in one objective.

    Attributes:
        differs: the states in which the sets of optimal actions differ, bool of shape (S,). With a
            discount all reachable states count; under a time limit, a state counts at the steps at
            which an optimal policy may be in it.
        optimal: the optimal actions in the original rewards, bool of shape (S, A); under a time
            limit with all steps left.
        shaped: the same in the shaped rewards.
        optimum: the highest expected return in the original rewards.
        returns: the original returns of the policies that are optimal in the shaped rewards.
        judged: the same without a discount and under the time limit.
        judged_before: the same of the policies that are optimal in the original rewards. Their
            distance from the optimum under the limit is due to the discount.
        policy: a policy that is optimal in the original rewards, actions of shape (horizon, S). It
            does what ``worst_policy`` does wherever that is optimal.
        worst_policy: of the policies that are optimal in the shaped rewards, the one with the
            lowest original return under the time limit, of the same shape.
        factor: c, if the shaped rewards are c > 0 times the original ones plus the difference of a
            potential, in the mean over outcomes; None otherwise, and without a discount.
        potential: that potential, shape (S,), or None.
    """

    differs: Bools
    optimal: Bools
    shaped: Bools
    optimum: float
    returns: Ends
    judged: Ends
    judged_before: Ends
    policy: Ints
    worst_policy: Ints
    factor: float | None = None
    potential: Floats | None = None

    @property
    def is_same(self) -> bool:
        """Whether the optimal policies are the same."""
        return not self.differs.any()


def discounted_effect(
    original: TransitionModel, shaped: TransitionModel, discount: float, horizon: int
) -> Effect:
    """Compare the policies that are optimal with a discount and without a time limit.

    Args:
        original: the decision process in which policies are judged.
        shaped: the same with shaped rewards. Its starting states do not matter; in states that it
            never reaches, every action counts as optimal.
        discount: at least 0 and below 1.
        horizon: the time limit under which returns are judged.

    Raises:
        ValueError: for an argument out of range, for models with different states or actions, and
            for models that are too large.
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount is {discount}, it must be at least 0 and below 1")
    _check(original, shaped, horizon)
    everywhere = original.reachable / original.reachable.sum()
    plan = policy_iteration(original, discount)
    shaped_plan = policy_iteration(replace(shaped, initial=everywhere), discount)
    optimal = _best(original, plan.action_values)
    theirs = _best(shaped, shaped_plan.action_values) | ~shaped.reachable[:, None]
    bad = replace(original, reward=-original.reward)

    def judged(mask: Bools) -> Ends:
        best, worst = (finite_horizon_optimum(m, horizon, mask=mask) for m in (original, bad))
        return best.start_value, 0.0 - worst.start_value

    worst_policy = finite_horizon_optimum(bad, horizon, mask=theirs).policy.astype(np.int64)
    is_optimal = optimal[np.arange(original.n_states), worst_policy]
    best, worst = (policy_iteration(m, discount, theirs).start_value for m in (original, bad))
    return Effect(
        original.reachable & (optimal != theirs).any(axis=1),
        optimal,
        theirs,
        plan.start_value,
        (best, 0.0 - worst),
        judged(theirs),
        judged(optimal),
        np.where(is_optimal, worst_policy, plan.policy),
        worst_policy,
        *_potential(original, shaped, plan, shaped_plan),
    )


def effect_under_limit(original: TransitionModel, shaped: TransitionModel, horizon: int) -> Effect:
    """Compare the policies that are optimal without a discount under a time limit.

    Optimal actions depend on the steps left. So the sets of optimal actions are compared at each
    step, in the states that an optimal policy may be in: if they agree there, the optimal policies
    are the same. Arguments and errors are those of `discounted_effect`.
    """
    _check(original, shaped, horizon)
    values = [np.zeros(original.n_states)] * 4
    rows: list[tuple[Bools, Bools, Ints, Ints]] = []
    for _ in range(horizon):
        found = [
            model.action_values(later)
            for model, later in zip((original, shaped, original, original), values, strict=True)
        ]
        optimal = _best(original, found[0])
        theirs = _best(shaped, found[1]) | ~shaped.reachable[:, None]
        best, worst = np.where(theirs, found[2], -np.inf), np.where(theirs, found[3], np.inf)
        action = worst.argmin(axis=1)
        is_optimal = np.take_along_axis(optimal, action[:, None], axis=1)[:, 0]
        rows.append(
            (optimal, theirs, np.where(is_optimal, action, found[0].argmax(axis=1)), action)
        )
        earlier = [*(each.max(axis=1) for each in (found[0], found[1], best)), worst.min(axis=1)]
        if all(map(np.array_equal, earlier, values)):
            break
        values = earlier
    in_time = [rows[min(left, len(rows)) - 1] for left in range(horizon, 0, -1)]
    differs, here = np.zeros(original.n_states, np.bool_), original.initial > 0
    for optimal, theirs, _, _ in in_time:
        differs |= here & (optimal != theirs).any(axis=1)
        here = original.after(here[:, None] & optimal)
    optimum, _, best_return, worst_return = (float(original.initial @ each) for each in values)
    ends, policies = (best_return, worst_return), zip(*in_time, strict=True)
    _, _, policy, worst_policy = (np.array(each) for each in policies)
    return Effect(
        differs, *in_time[0][:2], optimum, ends, ends, (optimum, optimum), policy, worst_policy
    )


def _check(original: TransitionModel, shaped: TransitionModel, horizon: int) -> None:
    told = [f"{m.n_states:,} states and {m.n_actions} actions" for m in (shaped, original)]
    if told[0] != told[1]:
        raise ValueError(f"{told[0]} cannot be compared with {told[1]}")
    size = max(original.prob.size, shaped.prob.size)
    if size > MOST_OUTCOMES or size * horizon > MOST_BACKED_UP:
        raise ValueError(f"{told[0]} under a limit of {horizon:,} steps are too many to plan")


def _best(model: TransitionModel, action_values: Floats) -> Bools:
    """The best actions of each state, ties up to rounding included, bool of shape (S, A)."""
    best = action_values.max(axis=1, keepdims=True)
    largest = max(np.abs(action_values).max(), np.abs(model.reward).max())
    margin = np.maximum(EQUAL * np.abs(best), EQUAL_NEAR_ZERO * largest)
    return np.asarray(action_values >= best - margin)


def _potential(
    original: TransitionModel, shaped: TransitionModel, plan: Plan, shaped_plan: Plan
) -> tuple[float | None, Floats | None]:
    """The factor and the potential that turn the original rewards into the shaped ones, or None.

    They exist if and only if the advantages of actions in the two optima are proportional: then the
    potential is the factor times the original's optimal values, minus those of the shaped rewards.
    The factor is found by least squares.
    """
    states, moves = original.reachable, ("prob", "next_state", "terminated")
    if original.prob.shape != shaped.prob.shape or not all(
        np.array_equal(getattr(original, name)[states], getattr(shaped, name)[states])
        for name in moves
    ):
        return None, None
    ours, theirs = (
        (each.action_values - each.values[:, None])[states] for each in (plan, shaped_plan)
    )
    largest = np.abs(plan.values).max(), np.abs(shaped_plan.values).max()
    ours = np.where(np.abs(ours) > EQUAL * largest[0], ours, 0.0)  # smaller ones are rounding
    factor = float((ours * theirs).sum() / (ours**2).sum()) if ours.any() else 1.0
    margin = EQUAL * max(factor * largest[0], largest[1])
    if factor <= 0 or np.abs(theirs - factor * ours).max() > margin:
        return None, None
    factor = 1.0 if abs(factor - 1) < EQUAL else factor
    potential = factor * plan.values - shaped_plan.values
    potential[np.abs(potential) <= margin] = 0.0
    return factor, potential
