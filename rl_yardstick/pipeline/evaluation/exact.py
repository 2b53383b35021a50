"""Computes the value of an agent's policy exactly, instead of sampling it.

If the transition model of the environment is known, the evaluator queries the policy in all states
at once, and computes its expected return under the time limit, without evaluation noise.

Where observations hide the state, there are three optima: of policies of the state, of policies of
all observations so far, and of memoryless policies, which use only the current observation. An
agent's score uses that of its kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick import mdp
from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.envs import found_models, known_models
from rl_yardstick.envs.cut_world import cut_world
from rl_yardstick.envs.layout import GridLayout, grid_layout
from rl_yardstick.envs.model_of import FoundModel
from rl_yardstick.mdp.beliefs import Bracket, memory_optimum
from rl_yardstick.mdp.memoryless import PROVED, BestMemoryless, best_memoryless, observation_groups
from rl_yardstick.mdp.transition_model import Bools, Floats
from rl_yardstick.pipeline.environments import kwargs_of, make_single_env, training_changes
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.yardstick import (
    FAILED,
    Evaluation,
    HiddenState,
    OtherReturns,
    Yardstick,
)
from rl_yardstick.pipeline.spec import TrainSpec

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

# Limit for the array with the observations of all states.
MOST_BYTES_OBSERVED = 1 << 30
# Backups of backward induction (steps x outcomes of all states and actions); a second does some
# hundred million. Above FEW_BACKUPS, a faster method is tried first.
FEW_BACKUPS = 200_000_000
MOST_BACKUPS = 20_000_000_000
# The most steps x outcomes of all states and actions for which `OtherReturns` are computed: in a
# millisecond on a small model, and in about two seconds at most.
MOST_OUTCOMES_OF_OTHERS = 600_000_000
# An episode is stuck in a few states if it spends nearly all of its last steps there.
LAST_STEPS, NEARLY_ALL = 100, 0.99
MOST_STATES_NAMED = 3
# The most cached evaluators, and the most states of their models.
MOST_KEPT = 8
MOST_STATES_KEPT = 20_000


Result = TypeVar("Result")


class OfLastPolicy(Generic[Result]):
    """Caches the last result of a function of a policy, because policies often stay the same."""

    def __init__(self, work: Callable[[NDArray[Any]], Result]) -> None:
        self._work = work
        self._last: tuple[NDArray[Any], Result] | None = None

    def __call__(self, policy: NDArray[Any]) -> Result:
        """Return the result for a policy in one of the forms of `mdp.evaluation`."""
        last = self._last
        if last is not None and last[0].dtype == policy.dtype and np.array_equal(last[0], policy):
            return last[1]
        result = self._work(policy)
        self._last = policy.copy(), result
        return result


@dataclass(frozen=True, eq=False)
class HiddenScale:
    """The optima of an environment whose observations hide the state."""

    full_optimum: float
    baseline: float
    memory: Bracket  # of policies of all observations so far
    now: Bracket  # of memoryless policies
    best: BestMemoryless | None  # the best memoryless policy found; None if none was searched

    def yardstick(self, with_memory: bool) -> Yardstick:
        """The yardstick for agents with memory, or for memoryless agents."""
        lower, upper = self.memory if with_memory else self.now
        hidden = HiddenState(self.full_optimum, (self.memory.lower, self.memory.upper), with_memory)
        return Yardstick(upper, self.baseline, None if lower == upper else lower, hidden=hidden)

    @property
    def note(self) -> str | None:
        """A line on the best memoryless policy, if it is stochastic."""
        best = self.best
        if best is None or not best.needs_chance:
            return None
        found = [
            "" if known else " found" for known in (best.lower == best.upper, best.is_firm_known)
        ]
        return (
            f"the best memoryless policy{found[0]} is stochastic and returns {best.lower:.2f}; "
            f"the best deterministic one{found[1]}, as in evaluations, returns {best.firm:.2f}"
        )


def hidden_scale(
    model: mdp.TransitionModel,
    observations: NDArray[np.generic],
    horizon: int,
    full_optimum: float,
    baseline: float,
) -> HiddenScale | None:
    """The optima under partial observability; None if a memoryless policy reaches the optimum.

    ``observations`` has the states along its first axis; ``full_optimum`` is that of policies of
    the state, ``baseline`` the return of the best random or constant policy.
    """
    groups = observation_groups(observations, model.reachable)
    if groups is None:
        return None
    memory = memory_optimum(model, groups, horizon) or Bracket(baseline, full_optimum)
    most = min(memory.upper, full_optimum)
    best = best_memoryless(model, groups, horizon, most)
    if best is not None and best.lower >= full_optimum - PROVED * max(1.0, abs(full_optimum)):
        return None
    now = Bracket(baseline, most)
    if best is not None:
        now = Bracket(max(best.lower, baseline), max(best.upper, baseline))
    least = memory.lower if memory.lower == memory.upper else max(memory.lower, now.lower)
    return HiddenScale(full_optimum, baseline, Bracket(least, most), now, best)


@dataclass(frozen=True)
class ExactEvaluator:
    """Evaluates agents on an environment whose model is known."""

    model: mdp.TransitionModel  #: dynamics of the evaluation environment
    observations: NDArray[Any]  #: of each state, states along the first axis
    horizon: int  #: the time limit
    success: Bools | None  #: the outcomes that count as success, shape (S, A, K), or None
    yardstick: Yardstick  #: the returns of optimum and baseline
    layout: GridLayout | None = None  #: where the states lie on a map, for grid worlds
    masks: Bools | None = None  #: action masks, shape (S, A), for agents that use them
    scale: HiddenScale | None = None  #: the optima if observations hide the state
    found: FoundModel | None = None  #: the search, if it found the model

    def __call__(self, agent: BaseAlgorithm, deterministic: bool = True) -> Evaluation:
        """Evaluate the agent's current policy exactly."""
        return self.worth(self.policy(agent, deterministic))

    def at_the_end(self, agent: BaseAlgorithm) -> Evaluation:
        """Evaluate the final policy, and compute its `other_returns`."""
        return replace(self(agent), others=self.other_returns(agent))

    def other_returns(self, agent: BaseAlgorithm) -> OtherReturns:
        """The returns of the agent's stochastic policy, and of its greedy one under its discount.

        Empty if the model is large.
        """
        from rl_yardstick.agents import policies

        found, discount = OtherReturns(), getattr(agent, "gamma", None)
        if self.model.prob.size * self.horizon > MOST_OUTCOMES_OF_OTHERS:
            return found
        with suppress(TypeError, ValueError):  # an agent's probabilities may not be known
            policy = self.policy(agent, deterministic=False)
            # The mean alone takes a fifth of the time that `policy_return` takes.
            values = mdp.state_values(self.model, policy, self.horizon)
            found = OtherReturns(policies.acts_by(agent), float(self.model.initial @ values))
        if isinstance(discount, int | float) and 0 <= discount <= 1:
            greedy = self.policy(agent, deterministic=True)
            worth = mdp.policy_return(self.model, greedy, self.horizon, discount).expected_return
            optimum = self._optimum_under(discount) if self.scale is None else None
            found = replace(
                found, discount=discount, discounted_return=worth, discounted_optimum=optimum
            )
        return found

    @cached_property
    def _optimum_under(self) -> Callable[[float], float]:
        """The function from a discount to the optimum of agents that see the state."""
        return cache(lambda d: mdp.finite_horizon_optimum(self.model, self.horizon, d).start_value)

    @cached_property
    def worth(self) -> OfLastPolicy[Evaluation]:
        """The function from a policy to its evaluation."""

        def worth(policy: NDArray[Any]) -> Evaluation:
            found = mdp.policy_return(self.model, policy, self.horizon, success=self.success)
            rate, std = found.success_rate, float(np.sqrt(found.return_variance))
            returns, lengths = np.array([found.expected_return]), np.array([found.expected_length])
            successes = None if rate is None else np.array([rate])
            return Evaluation(returns, lengths, successes, std, self.yardstick)

        return OfLastPolicy(worth)

    @cached_property
    def values(self) -> OfLastPolicy[Floats]:
        """The function from a policy to its state values, shape (S,); see `state_values`."""
        return OfLastPolicy(lambda p: mdp.state_values(self.model, p, self.horizon))

    @cached_property
    def optimum(self) -> tuple[Floats, Bools]:
        """The optimal state values, shape (S,), and the optimal actions, shape (S, A)."""
        return mdp.optimal_choices(self.model, self.horizon)

    def policy(self, agent: BaseAlgorithm, deterministic: bool) -> NDArray[Any]:
        """The policy: probabilities (S, A), or actions (S,), or actions by step (horizon, S)."""
        from rl_yardstick.agents import policies
        from rl_yardstick.agents.planning import PlanningAgent, RandomAgent

        if isinstance(agent, PlanningAgent):
            n_steps = 1 if agent.policy.is_stationary else self.horizon
            return agent.policy.actions_after(self.observations[None], np.arange(n_steps)[:, None])
        if deterministic and not isinstance(agent, RandomAgent):
            return policies.best_actions(agent, self.observations, self.masks)
        return policies.policy_matrix(agent, self.observations, deterministic, self.masks)

    def instead(self, agent: BaseAlgorithm, found: Evaluation) -> str | None:
        """What a failed agent's greedy policy does; None if it has not failed, or is random."""
        from rl_yardstick.agents.planning import RandomAgent

        if isinstance(agent, RandomAgent):
            return None
        policy, yardstick = self.policy(agent, deterministic=True), self.yardstick
        has_failed = yardstick.has_scale and yardstick.score(found.mean_return) < FAILED
        if not has_failed:  # unless only the best policies end their episodes
            best = self.optimum[1].argmax(axis=1)
            has_failed = self.out_of_time(best) < NEARLY_ALL <= self.out_of_time(policy)
        return self.ending(policy) if has_failed else None

    def out_of_time(self, policy: NDArray[Any]) -> float:
        """The share of a policy's episodes that run out of time."""
        return float(mdp.last_visits(self.model, policy, self.horizon, 1).sum())

    def ending(self, policy: NDArray[Any]) -> str:
        """How the episodes of a policy end, or in which states they get stuck."""
        model, horizon = self.model, self.horizon
        share = self.out_of_time(policy)
        if share < 0.5:
            found = mdp.policy_return(model, policy, horizon, success=self.success)
            end = f"{1 - share:.0%} of its episodes end before the time limit"
            rate = found.success_rate
            return end if rate is None else f"{end}, {rate:.1%} of all with success"
        late = mdp.last_visits(model, policy, horizon, min(LAST_STEPS, max(horizon // 2, 1)))
        order = np.argsort(-late, kind="stable")
        n_states = int(np.searchsorted(np.cumsum(late[order]), NEARLY_ALL * late.sum())) + 1
        named = order[:MOST_STATES_NAMED]
        places = [f"state {state}" for state in named]
        if self.layout is not None:
            places = [self.layout.place_name(int(cell)) for cell in self.layout.cells[named]]
        where = f"it stays at {places[0]}"
        if n_states > MOST_STATES_NAMED:
            n_reachable = int(model.reachable.sum())
            where = f"it never leaves {n_states} of {n_reachable} states, such as {places[0]}"
        elif n_states > 1:
            where = f"it circles between {'; '.join(places[:n_states])}"
        return f"{share:.0%} of its episodes run out of time: {where}"

    def obstacle(self, agent: BaseAlgorithm, deterministic: bool = True) -> str:
        """Why the policy cannot be computed, or only too slowly; empty if it can."""
        from rl_yardstick.agents import policies

        return policies.obstacle(agent, self.observations, self.masks, self.horizon, deterministic)


def is_wrapped_as_vector(spec: TrainSpec) -> bool:
    """Whether a VecEnv wrapper changes the agent's observations."""
    return bool(spec.normalize is not None or spec.frame_stack or spec.vec_env_wrapper)


def exact_evaluator(spec: TrainSpec) -> ExactEvaluator | None:
    """The exact evaluator of a run, or None if episodes have to be sampled."""
    return None if is_wrapped_as_vector(spec) else evaluator_of_single(spec)


_kept: dict[str, ExactEvaluator] = {}


def evaluator_of_single(spec: TrainSpec) -> ExactEvaluator | None:
    """Like `exact_evaluator`, but ignores VecEnv wrappers; cached for later runs of the process."""
    known, agent, masks = gym.registry[spec.env_id], ALGORITHMS.get(spec.algo), "mask_actions"
    # Some agents number the members of spaces.
    numbered = None if agent is None else (agent.numbers_spaces, agent.observations, agent.actions)
    own = sorted(kwargs_of(spec).items()), spec.algorithm.get(masks), numbered
    key = repr((known, own, found_models.limits()))
    # Of the user's own code, the key tells too little.
    is_kept = isinstance(known.entry_point, str) and not (spec.env_wrapper or spec.gym_packages)
    found = _kept.pop(key, None) if is_kept else None
    if found is None:
        with closing(make_single_env(spec)) as env:
            found = evaluator_in(env)
    if found is not None and is_kept and found.model.n_states <= MOST_STATES_KEPT:
        _kept[key] = found
        if len(_kept) > MOST_KEPT:
            del _kept[next(iter(_kept))]
    return found


def evaluator_in(env: gym.Env[Any, Any]) -> ExactEvaluator | None:
    """The exact evaluator of an environment, or None if episodes have to be sampled."""
    model, horizon = known_models.transition_model(env), known_models.time_limit(env)
    space = env.observation_space
    n_bytes = math.prod(space.shape or ()) * np.dtype(space.dtype).itemsize
    if model is None or horizon is None or model.n_states * n_bytes > MOST_BYTES_OBSERVED:
        return None
    observations = known_models.observations_of_states(env)
    if observations is None or (optimum := _optimum(model, horizon)) is None:
        return None
    masks = known_models.action_masks_of_states(env)
    success, layout = known_models.success_outcomes(env), grid_layout(env)
    if layout is not None and layout.n_states != model.n_states:
        layout = None  # the states of a user's grid world are not cells
    baseline = float(mdp.baseline_return(model, horizon))
    scale = hidden_scale(model, observations, horizon, optimum, baseline)
    yardstick = Yardstick(optimum, baseline) if scale is None else scale.yardstick(False)
    found = known_models.found_model(env)
    return ExactEvaluator(
        model, observations, horizon, success, yardstick, layout, masks, scale, found
    )


def told_of_bins(spec: TrainSpec, agent: BaseAlgorithm) -> str | None:
    """The return of the greedy policy and the optimum in `cut_world`; None if these are unknown."""
    from rl_yardstick.agents import policies

    model = None if training_changes(spec) else getattr(agent, "cut_world", None)
    with closing(make_single_env(spec)) as env, suppress(TypeError, ValueError):
        horizon, model = known_models.time_limit(env), model or cut_world(env)
    if model is None or horizon is None or (optimum := _optimum(model, horizon)) is None:
        return None
    bins, scale = np.arange(model.n_states), Yardstick(optimum, optimum)
    evaluator = ExactEvaluator(model, bins, horizon, None, scale)
    unknown = is_wrapped_as_vector(spec) or evaluator.obstacle(agent)
    if unknown or policies.why_not_exact(agent, bins):
        return None
    mine = f"return {evaluator(agent).mean_return:.2f} in the cut world of {len(bins):,} bins"
    return f"{mine}, whose optimum is {optimum:.2f}; neither bounds the return in {spec.env_id}"


def _optimum(model: mdp.TransitionModel, horizon: int) -> float | None:
    """The highest expected return under the time limit; None if planning takes too long."""
    n_backups = int(model.reachable.sum()) * model.n_actions * model.n_outcomes * horizon
    if n_backups > FEW_BACKUPS:
        found = mdp.optimum_far_from_limit(model, horizon)
        if found is not None or n_backups > MOST_BACKUPS:
            return found
    return mdp.finite_horizon_optimum(model, horizon).start_value


def known_model(env: gym.Env[Any, Any], env_id: str) -> mdp.TransitionModel:
    """The model of an environment with its wrappers; UserError if it is not known."""
    if (model := known_models.transition_model(env)) is not None:
        return model
    reason = "" if (why := known_models.why_unknown(env)) is None else f": {why}"
    raise UserError(f"the model of {env_id} is not known{reason}")


def model_refusal(spec: TrainSpec, only_surprising: bool = True) -> str | None:
    """Why the environment's model is not known, in one line; None if it is, or no surprise."""
    if is_wrapped_as_vector(spec):
        return None
    with closing(make_single_env(spec)) as env:
        return known_models.why_unknown(env, only_surprising)
