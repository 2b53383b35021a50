"""How hard a decision process is to learn: measures that follow from its model alone.

All are exact up to rounding, except the effective horizon, which is a bound. Episodes have a time
limit, returns are undiscounted, and random actions are uniform. `docs/evaluation.md` explains the
measures, and which agents suffer from which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rl_yardstick.machine_code.compiling import compiled
from rl_yardstick.mdp.evaluation import (
    OPTIMAL_TOLERANCE,
    baseline_policies,
    optimal_choices,
    policy_return,
    state_visitation,
)
from rl_yardstick.mdp.finite_horizon import FiniteHorizonPlan, back_up, finite_horizon_optimum
from rl_yardstick.mdp.graph import steps_to_end
from rl_yardstick.mdp.planning import action_value, policy_iteration, surely_ending
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, TransitionModel

# Above these limits, a measure is None. Outcomes of reachable states, times these states.
MOST_FOR_DIAMETER = 5_000_000
# Values of reachable states at all steps, 8 bytes each, in three tables.
MOST_VALUES = 10_000_000
# Outcomes of reachable states times steps times depths; and the fewest depths it must allow.
MOST_LOOKED_AT = 1_000_000_000
LEAST_DEPTHS = 10


@dataclass(frozen=True)
class Hardness:
    """How hard a decision process is. A measure is None if undefined, or the model too large."""

    states: int  # S, the states of the model
    reachable_states: int  # those in which an agent may have to act
    diameter: float | None  # steps: see `diameter`; None without connected pairs
    connected: float | None  # share of ordered pairs of reachable states that count for it, 0 to 1
    smallest_gap: float | None  # return: see `action_gaps`; None where no action is a mistake
    mean_gap: float | None  # return: the same, averaged over the states that the optimum visits
    return_variance: float  # return squared, of one episode of the optimal policy
    lookahead: int | None  # steps: k, see `looking_ahead`
    effective_horizon: float | None  # steps: a bound, see `looking_ahead`; None if random
    random_steps_to_reward: float  # steps of random actions up to the first positive reward
    random_episodes_to_reward: float  # the same in episodes; infinite if there is no such reward
    random_steps_to_goal: float | None  # steps to the first success; None where it is not defined


def hardness_of(model: TransitionModel, horizon: int, success: Bools | None = None) -> Hardness:
    """All measures; ``success`` are the outcomes that end an episode well, bool of (S, A, K)."""
    plan = finite_horizon_optimum(model, horizon)
    largest, connected = diameter(model) or (None, None)
    smallest, mean = action_gaps(model, plan)
    lookahead, effective_horizon = looking_ahead(model, horizon)
    steps, episodes = random_wait(model, model.reward > 0, horizon)
    return Hardness(
        states=model.n_states,
        reachable_states=int(model.reachable.sum()),
        diameter=largest,
        connected=connected,
        smallest_gap=smallest,
        mean_gap=mean,
        return_variance=policy_return(model, plan.policy, horizon).return_variance,
        lookahead=lookahead,
        effective_horizon=effective_horizon,
        random_steps_to_reward=steps,
        random_episodes_to_reward=episodes,
        random_steps_to_goal=None if success is None else random_wait(model, success, horizon)[0],
    )


# Steps from state to state.


def diameter(model: TransitionModel) -> tuple[float, float] | None:
    """The largest number of steps that the fastest policy needs from one state to another.

    Jaksch, Ortner and Auer, Near-Optimal Regret Bounds for Reinforcement Learning, 2010,
    definition 1: the maximum, over ordered pairs of states, of the smallest expected number of
    steps from the first to the second. Here the states are the reachable ones, and pairs count if
    some policy surely arrives before the episode terminates; the paper's diameter is infinite if
    a pair does not count. There is no time limit.

    Returns:
        The diameter in steps, and the share of ordered pairs that count; where it is 1, this is
        their diameter. None where no pair counts or the model is too large.
    """
    n = int(model.reachable.sum())
    if n * n * model.n_actions * model.n_outcomes > MOST_FOR_DIAMETER:
        return None
    times = [hitting_times(model, int(state)) for state in np.flatnonzero(model.reachable)]
    found = np.array(times)[:, model.reachable]
    counts = np.isfinite(found) & (found > 0)
    if not counts.any():
        return None
    return float(found[counts].max()), float(counts.sum() / (n * (n - 1)))


def hitting_times(model: TransitionModel, target: int) -> Floats:
    """The smallest expected number of steps from each state to ``target``, shape (S,).

    Infinite where no policy surely arrives before the episode terminates, and in unreachable
    states.
    """
    at = np.arange(model.n_states) == target
    ends = (model.terminated & (model.prob > 0)).any(axis=2)
    sure, allowed = surely_ending(model, model.reachable[:, None] & ~ends, at)
    times = np.where(at, 0.0, np.inf)
    going = np.flatnonzero(sure & ~at)
    if not going.size:
        return times
    if (model.prob.max(axis=2)[allowed & ~at[:, None]] == 1).all():
        times[going] = steps_to_end(model, allowed, at)[0][going]
        return times
    # A model of those states alone, which ends at the target. Actions that leave them are replaced
    # by an action that does not.
    used = np.where(allowed, np.arange(model.n_actions), allowed.argmax(axis=1)[:, None])[going]
    rows = going[:, None], used
    place = np.zeros(model.n_states, np.int64)
    place[going] = np.arange(len(going))
    prob, next_state = model.prob[rows], model.next_state[rows]
    way = TransitionModel(
        prob=prob,
        next_state=place[next_state],
        reward=np.full(prob.shape, -1.0),
        terminated=next_state == target,
        initial=np.full(len(going), 1 / len(going)),
    )
    times[going] = -policy_iteration(way, 1.0).values
    return times


# Suboptimal actions.


def action_gaps(
    model: TransitionModel, plan: FiniteHorizonPlan
) -> tuple[float | None, float | None]:
    """The value of the best action minus that of the best suboptimal one.

    The gap of Simchowitz and Jamieson, Non-Asymptotic Gap-Dependent Regret Bounds for Tabular
    MDPs, 2019, with all steps of the time limit left. Actions within 1e-9 of the best count as
    optimal. States without a suboptimal action have no gap. ``plan`` is the model's optimum.

    Returns:
        The smallest gap of a reachable state, and the mean over states, weighted by the expected
        visits of the optimal policy; both in return. None where there is no gap.
    """
    horizon = plan.horizon
    values, optimal = optimal_choices(model, horizon)
    later = finite_horizon_optimum(model, horizon - 1).values if horizon > 1 else 0 * values
    worth = model.action_values(later)
    gaps = values - np.where(optimal, -np.inf, worth).max(axis=1)
    visits = np.where(np.isfinite(gaps), state_visitation(model, plan.policy, horizon), 0.0)
    seen = visits > 0
    smallest = float(gaps[np.isfinite(gaps)].min(initial=np.inf))
    mean = float(visits[seen] @ gaps[seen] / visits.sum()) if seen.any() else None
    return (smallest if np.isfinite(smallest) else None), mean


# Random actions.


def random_wait(model: TransitionModel, marked: Bools, horizon: int) -> tuple[float, float]:
    """The expected time until random actions reach the first marked outcome, over episodes.

    By Wald's identity: the expected length of an episode that stops at a marked outcome, divided by
    the probability that an episode has such an outcome.

    Args:
        model: the decision process.
        marked: the outcomes, bool of shape (S, A, K).
        horizon: the time limit in steps, after which a new episode begins.

    Returns:
        The expected number of steps, and of episodes; infinite where it never happens.
    """
    stopped = replace(model, terminated=model.terminated | marked, reward_variance=None)
    uniform = baseline_policies(model)[0]
    found = policy_return(stopped, uniform, horizon, success=marked)
    if not found.success_rate:
        return math.inf, math.inf
    return found.expected_length / found.success_rate, 1 / found.success_rate


# Looking ahead.


def looking_ahead(model: TransitionModel, horizon: int) -> tuple[int | None, float | None]:
    """How many steps an agent must look ahead, if it evaluates the rest by random actions.

    Laidlaw, Russell and Dragan, Bridging RL Theory and Practice with the Effective Horizon, 2023.
    Let Q(1) be the action values of random actions, and Q(k + 1) the result of a sweep of value
    iteration over Q(k), for each number of steps left. A model is *k-QVI-solvable* if every policy
    that is greedy for Q(k) is optimal. The first result is the smallest such k.

    If transitions are deterministic, Greedy Over Random Policy (GORP) tries each sequence of k
    actions, followed by random ones, in m episodes; takes the first action of the best sequence;
    and repeats this in the next state. The *effective horizon* is the smallest k + log_A(m) for
    which GORP is optimal with probability 1/2; it takes T^2 A^(k + log_A m) steps at most. The
    second result is a bound on it, as their theorem 5.4 but with the constants that follow from
    Bernstein's inequality, and for rewards of any sign: m = 8 (v + b d / 6) / d^2 ln(2 T A^k) are
    enough, where d is the gap of Q(k) between optimal and other actions, b = Q - W the range of
    returns after an action, from the lowest return W to the optimal value Q, and v = (Q(k) - W) b;
    in the worst state that GORP visits. T is the time limit or the longest possible episode,
    whichever is less. The bound is at most T, since sequences of T actions leave nothing random.

    Values within 1e-9 of each other count as equal, relative to them where they are above 1.

    Returns:
        k, and the bound in steps. None where the model is too large or the depths that time allows
        do not suffice; the bound also where transitions or rewards are random, or there is only
        one action.
    """
    n_states, n_actions = int(model.reachable.sum()), model.n_actions
    steps = _longest_episode(model, min(horizon, MOST_VALUES // n_states + 1))
    size = steps * n_states * n_actions * model.n_outcomes
    deepest = min(steps, MOST_LOOKED_AT // size)
    if steps * n_states > MOST_VALUES or deepest < min(steps, LEAST_DEPTHS):
        return None, None
    # Highest and lowest values, and those of random actions, with 0, 1, ... steps left.
    best, worst, current = (np.zeros((steps + 1, model.n_states)) for _ in range(3))
    for left in range(1, steps + 1):
        best[left] = model.action_values(best[left - 1]).max(axis=1)
        worst[left] = model.action_values(worst[left - 1]).min(axis=1)
        current[left] = model.action_values(current[left - 1]).mean(axis=1)
    is_random = ((model.prob > 0).sum(axis=2) > 1)[model.reachable].any()
    bounded = n_actions > 1 and not is_random and model.reward_variance is None
    dynamics, start, states = model.dynamics, model.initial > 0, np.flatnonzero(model.reachable)
    everything, actions = model.allowed_actions(), np.zeros(model.n_states, np.uint64)
    lookahead, bound = None, float(steps)
    for k in range(1, deepest + 1):
        rows = best, worst, current
        solves, spread = _greedy_is_optimal(dynamics, start, *rows, OPTIMAL_TOLERANCE)
        if solves and lookahead is None:
            lookahead = k
        if bounded and np.isfinite(spread):
            choices = math.log(2 * steps) + k * math.log(n_actions)
            episodes = max(1, math.ceil(8 * spread * choices))
            bound = min(bound, k + math.log(episodes) / math.log(n_actions))
        if lookahead is not None and (k + 1 >= bound or not bounded):
            break
        # A sweep of value iteration, in place: with each number of steps left from one step fewer.
        for left in range(steps, 0, -1):
            later, now = current[left - 1], current[left]
            back_up(dynamics, everything, 1.0, states, later, now, actions)
    return lookahead, bound if bounded and lookahead is not None else None


def _longest_episode(model: TransitionModel, horizon: int) -> int:
    """The largest number of steps that an episode can have, at most the time limit."""
    here = model.initial > 0
    for step in range(1, horizon):
        here = model.after(np.repeat(here[:, None], model.n_actions, axis=1))
        if not here.any():
            return step
    return horizon


@compiled
def _greedy_is_optimal(
    model: Dynamics, start: Bools, best: Floats, worst: Floats, current: Floats, tolerance: float
) -> tuple[bool, float]:
    """Whether all greedy policies are optimal, and the largest (v + b d / 6) / d^2 for GORP.

    Q(k) follows from the state values ``current``. Greedy policies take the best actions; GORP may
    take each action that looks better than the best mistake, see `looking_ahead`.
    """
    prob, next_state, terminated, mean_reward = model
    n_states, n_actions = mean_reward.shape
    is_optimal, spread = True, 0.0
    greedy, likely = start.copy(), start.copy()
    seems, truly, lowest = np.empty(n_actions), np.empty(n_actions), np.empty(n_actions)
    for left in range(len(best) - 1, 0, -1):
        next_greedy, next_likely = np.zeros(n_states, np.bool_), np.zeros(n_states, np.bool_)
        for state in range(n_states):
            if not (greedy[state] or likely[state]):
                continue
            top, mistake = -np.inf, -np.inf
            least = best[left, state] - tolerance * max(1.0, abs(best[left, state]))
            for action in range(n_actions):
                seems[action] = action_value(model, state, action, current[left - 1], 1.0)
                truly[action] = action_value(model, state, action, best[left - 1], 1.0)
                lowest[action] = action_value(model, state, action, worst[left - 1], 1.0)
                top = max(top, seems[action])
                if truly[action] < least:
                    mistake = max(mistake, seems[action])
            margin = tolerance * max(1.0, abs(top))
            gap = top - mistake
            if gap <= margin:
                is_optimal = is_optimal and not greedy[state]
                spread = np.inf
            elif likely[state] and mistake > -np.inf:
                for action in range(n_actions):
                    width = truly[action] - lowest[action]
                    variance = (seems[action] - lowest[action]) * width
                    spread = max(spread, (variance + width * gap / 6) / gap**2)
            for action in range(n_actions):
                taken = greedy[state] and seems[action] >= top - margin
                possible = likely[state] and seems[action] > mistake
                for k in range(prob.shape[2]):
                    if prob[state, action, k] > 0 and not terminated[state, action, k]:
                        reached = next_state[state, action, k]
                        next_greedy[reached] = next_greedy[reached] or taken
                        next_likely[reached] = next_likely[reached] or possible
        if not is_optimal:
            break
        greedy, likely = next_greedy, next_likely
    return is_optimal, spread
