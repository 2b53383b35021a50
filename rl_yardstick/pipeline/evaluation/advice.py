"""Describes what a failed agent does instead of its task, and proposes a first change.

If the agent's value of the start is about as low as the value of standing still for ever, the
discount hides the goal and must be nearer to 1. If the agent has tried its actions too rarely, it
needs more steps. A change is proposed only if exact planning shows that it can help.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.agents.planning import PlanningAgent, RandomAgent
from rl_yardstick.envs.known_models import observations_of_states, transition_model
from rl_yardstick.mdp import TransitionModel, policy_return, state_visitation, value_iteration
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.evaluation.sampled import Evaluation
from rl_yardstick.pipeline.evaluation.yardstick import FAILED
from rl_yardstick.pipeline.settings import shipped_hyperparams
from rl_yardstick.pipeline.spec import TrainSpec

SOLVED = 0.5  # planning must reach this score for a recommendation
NEAR_OPTIMUM = 0.01  # relative to the optimum
# The value of the start, divided by the value of standing still.
NEAR_STANDING_STILL = 0.8
# Training steps per pair of state and action: the least (FAR: if gamma is raised), and the advice.
FEW_STEPS, FEW_STEPS_FAR = 130, 400
MANY_STEPS = 1000
# Smaller differences between scores do not matter.
MATTERS = 0.05
# Planning with this many states x actions x outcomes takes about a second.
MOST_OUTCOMES = 500_000
# An episode is stuck in a few states if it spends nearly all of its last steps there.
LAST_STEPS, NEARLY_ALL = 100, 0.99
MOST_STATES_NAMED = 3


@dataclass(frozen=True)
class Advice:
    """Advice on a failed run."""

    instead: str  # what the greedy policy does instead of solving the task
    try_first: str | None  # the change that is likely to help; None without evidence for one


def advice(
    spec: TrainSpec, agent: BaseAlgorithm, evaluator: object, final: Evaluation, n_steps: int
) -> Advice | None:
    """Advice on a failed agent; None for others, or if the evaluation is not exact."""
    if not isinstance(evaluator, ExactEvaluator) or isinstance(agent, RandomAgent):
        return None
    policy, yardstick = evaluator.policy(agent, deterministic=True), evaluator.yardstick
    if policy.ndim == 2 and np.issubdtype(policy.dtype, np.integer):
        if len(policy) > 1:  # a planner's policy that depends on the time step
            return None
        policy = policy[0]
    # If a constant action is optimal, the score of a near-optimal return may be 0.
    near = yardstick.gap(final.mean_return) <= NEAR_OPTIMUM * abs(yardstick.optimum)
    if yardstick.score(final.mean_return) >= FAILED or near:
        best = evaluator.optimum[1].argmax(axis=1)
        # It has not failed, unless only the best policies end their episodes.
        if still_running(evaluator, policy, 1).sum() < NEARLY_ALL:
            return None
        if still_running(evaluator, best, 1).sum() >= NEARLY_ALL:
            return None
    instead = how_episodes_end(evaluator, policy)
    # Planning uses the state: its score says nothing about agents that do not observe the state.
    hides = evaluator.scale is not None
    return Advice(instead, None if hides else _try_first(spec, agent, evaluator, n_steps))


def still_running(evaluator: ExactEvaluator, policy: Any, n_last: int) -> Floats:
    """Expected visits to each state in the last steps before the limit, shape (S,)."""
    model, horizon = evaluator.model, evaluator.horizon
    visits = state_visitation(model, policy, horizon)
    if n_last < horizon:
        has_time = policy.ndim == 2 and policy.shape != model.prob.shape[:2]
        before = policy[: horizon - n_last] if has_time and len(policy) == horizon > 1 else policy
        visits = visits - state_visitation(model, before, horizon - n_last)
    return np.maximum(visits, 0.0)


def how_episodes_end(evaluator: ExactEvaluator, policy: Any) -> str:
    """Describe how the episodes of a policy end, or where they get stuck."""
    share, horizon = float(still_running(evaluator, policy, 1).sum()), evaluator.horizon
    if share < 0.5:
        found = policy_return(evaluator.model, policy, horizon, success=evaluator.success)
        end, rate = f"{1 - share:.0%} of its episodes end before the time limit", found.success_rate
        return end if rate is None else f"{end}, {rate:.1%} of all with success"
    late = still_running(evaluator, policy, min(LAST_STEPS, max(horizon // 2, 1)))
    order = np.argsort(-late, kind="stable")
    n_states = int(np.searchsorted(np.cumsum(late[order]), NEARLY_ALL * late.sum())) + 1
    named, layout = order[:MOST_STATES_NAMED], evaluator.layout
    places = [f"state {state}" for state in named]
    if layout is not None:
        places = [layout.place_name(int(cell)) for cell in layout.cells[named]]
    if n_states == 1:
        where = f"it stays at {places[0]}"
    elif n_states <= MOST_STATES_NAMED:
        where = f"it circles between {'; '.join(places[:n_states])}"
    else:
        n_reachable = int(evaluator.model.reachable.sum())
        where = f"it never leaves {n_states} of {n_reachable} states, such as {places[0]}"
    return f"{share:.0%} of its episodes run out of time: {where}"


def _try_first(
    spec: TrainSpec, agent: BaseAlgorithm, evaluator: ExactEvaluator, n_steps: int
) -> str | None:
    gamma = getattr(agent, "gamma", None)
    with closing(make_single_env(spec, training=True)) as env:
        model, observations = transition_model(env), observations_of_states(env)
    if model is None or observations is None or not isinstance(gamma, float):
        return None
    if model.prob.size > MOST_OUTCOMES or model.prob.shape != evaluator.model.prob.shape:
        return None
    is_near = share_of_standing_still(agent, model, observations, gamma) >= NEAR_STANDING_STILL
    nearer = max(1 - 0.5 / evaluator.horizon, gamma)
    plans = [value_iteration(model, discount).policy for discount in (gamma, nearer)]
    found = [policy_return(evaluator.model, plan, evaluator.horizon) for plan in plans]
    score, reached = (evaluator.yardstick.score(each.expected_return) for each in found)
    raises_gamma = nearer > gamma and (is_near or score < reached - MATTERS)
    n_tables = len(getattr(agent.policy, "q_tables", [0]))
    n_pairs = int(model.reachable.sum()) * model.n_actions * n_tables
    # A more distant goal takes longer to learn.
    few = FEW_STEPS_FAR if raises_gamma else FEW_STEPS
    needs_steps = n_steps < few * n_pairs and not isinstance(agent, PlanningAgent)
    if not (raises_gamma or needs_steps) or reached < SOLVED:
        return None
    flags, now = [], []
    if needs_steps:
        enough = max(MANY_STEPS * n_pairs, 4 * n_steps)
        unit: int = 10 ** max(len(str(enough)) - 2, 0)  # rounded up to two digits
        shipped = shipped_hyperparams(spec).get("n_timesteps") or 0
        flags.append(f"-n {max(-(-enough // unit) * unit, shipped)}")
        instead = ", instead of --n-episodes" if spec.n_episodes else ""
        now.append(f"{n_steps / n_pairs:.3g} for each state and action{instead}")
    if raises_gamma:
        flags.append(f"-params gamma:{nearer:.6g}")
        now.append(f"gamma {gamma:.6g}")
        if score < reached - MATTERS:
            now[-1] += f", where even exact planning scores {score:.2f}"
    return f"{' '.join(flags)} (now {'; '.join(now)})"


def share_of_standing_still(
    agent: BaseAlgorithm, model: TransitionModel, observations: Any, gamma: float
) -> float:
    """The agent's start value divided by the value of standing still; 0 if free or unknown."""
    tables = getattr(agent.policy, "q_tables", None)
    stays = (model.next_state == np.arange(model.n_states)[:, None, None]) & ~model.terminated
    stays &= (model.prob > 0) & model.reachable[:, None, None]
    if not stays.any() or gamma >= 1:
        return 0.0
    standing = float(model.reward[stays].max()) / (1 - gamma)
    if standing >= 0 or tables is None or observations.ndim != 1:
        return 0.0
    starts = np.flatnonzero(model.initial)
    values = tables.numpy().mean(axis=0)[observations[starts]].max(axis=1)
    return float(model.initial[starts] @ values) / standing
