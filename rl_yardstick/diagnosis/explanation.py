"""Explains where an agent loses return to the optimum, exactly, where the model is known.

The gap to the optimum is split in two ways, and both sums are exact. By state: the loss of the
agent's actions in each state (`mdp.gaps`). By part: a sequence of policies leads from the optimum
to the agent, each with one more of its handicaps, and each part is the cost of one handicap. Parts
may be negative.

1. Objective: the best policy for the agent's discount on its training environment, without a time
   limit.
2. Exploring: the same for agents that learn the values of their own exploring policy.
3. Not observable: the best memoryless policy.
4. Never tried: planning on the pairs of state and action that the agent has tried.
5. Values not settled: one exact look-ahead with the agent's own values.
6. Look-ahead: the agent itself.

A part says where the return is lost, not why. `diagnosis.proposals` says what may help, and
`experiments.study.intervention_study` tries it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.layout import action_names, state_name
from rl_yardstick.mdp import (
    TransitionModel,
    finite_horizon_optimum,
    policy_iteration,
    policy_return,
    state_values,
)
from rl_yardstick.mdp.evaluation import canonical_policy, policy_matrix
from rl_yardstick.mdp.gaps import GapByState, expected_next, gap_by_state, greedy_repairs
from rl_yardstick.mdp.memoryless import observation_groups
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.spec import TrainSpec

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

MOST_OUTCOMES = 500_000  # of a model to plan in for an agent's objective: about a second
TIE = 1e-9  # action values within this of the best, relative to it, count as ties
MOST_STATES, MOST_OF_GAP = 3, 0.5  # states are named where these many make up this share of the gap
SURELY = 0.99  # the probability of an end from which on it counts as sure
WORTH_A_LINE = 0.05  # repairs that regain less than this share of the gap have no line
ROUNDING = 1e-9  # returns within this of each other, relative to them, count as equal


@dataclass(frozen=True)
class Part:
    """One of the handicaps between the optimum and the agent."""

    name: str  #: ``objective``, ``exploring``, ``not observable``, ``never tried``, ...
    loss: float  #: what it costs, in return per episode
    meaning: str  #: what it is, in words


@dataclass(frozen=True)
class StateLoss:
    """A state in which the agent loses return."""

    state: int
    name: str  #: the name of the state
    loss: float  #: in return per episode
    visits: float  #: how often an episode acts there
    action: str  #: the agent's action there
    best: str  #: the best action there
    #: the agent's values of the two actions, their true values in its own objective, and the number
    #: of updates of each; None where unknown
    believed: tuple[float, float] | None = None
    true: tuple[float, float] | None = None
    updates: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class Explanation:
    """Where an agent loses return to the optimum."""

    optimum: float  #: the highest expected return under the time limit
    value: float  #: the agent's expected return
    score: float  #: on the scale of the yardstick
    ending: str  #: how its episodes end
    losses: Floats  #: the loss in each state, shape (S,); losses sum to the gap
    n_states: int  #: states in which it loses anything
    parts: tuple[Part, ...] = ()  #: their losses sum to the gap; empty where they are not known
    states: tuple[StateLoss, ...] = ()  #: the states that lose most, at most 20, the worst first
    repairs: tuple[tuple[str, float], ...] = ()  #: state, return after it and all earlier repairs
    discount: float | None = None  #: of its training
    own_gap: float | None = None  #: the gap at the start in that objective
    #: where losses are spread, what its policy does along the best road; or which states look alike
    road: str = ""
    is_caught: bool = False  #: whether most of its episodes run out of time
    looks_alike: bool = False  #: whether it cannot tell states apart
    proposals: tuple[str, ...] = ()  #: changes to try with ``--test``, the likeliest first

    @property
    def gap(self) -> float:
        """How far the agent stays behind the optimum."""
        return self.optimum - self.value

    @property
    def is_optimal(self) -> bool:
        """Whether the agent reaches the optimum, up to rounding."""
        return self.gap <= ROUNDING * max(1.0, abs(self.optimum))

    @property
    def is_concentrated(self) -> bool:
        """Whether few states make up most of the gap, and better actions there would close it.

        An agent that is caught loses most where it stands, not where it should have gone.
        """
        if self.is_caught or self.looks_alike:
            return False
        few = sum(state.loss for state in self.states[:MOST_STATES])
        return not self.is_optimal and few >= MOST_OF_GAP * self.gap

    def as_data(self) -> dict[str, Any]:
        """The explanation as JSON."""
        plain = ("optimum", "score", "ending", "n_states", "discount", "road", "proposals")
        return {
            **{name: getattr(self, name) for name in plain},
            "return": self.value,
            "gap": self.gap,
            "parts": [vars(part) for part in self.parts],
            "states": [vars(state) for state in self.states],
            "repairs": [{"name": name, "return": value} for name, value in self.repairs],
            "gap_in_own_objective": self.own_gap,
        }


class Task(NamedTuple):
    """The objective that the agent was trained for."""

    model: TransitionModel  # the model of the training environment
    discount: float
    epsilon: float  # exploration rate, if the agent learns the values of exploring, else 0
    lived: TransitionModel  # the model with these random actions
    for_discount: Floats  # optimal action values of the model, shape (S, A)
    own_values: Floats  # optimal action values of the objective itself


def explanation(spec: TrainSpec, agent: BaseAlgorithm, evaluator: ExactEvaluator) -> Explanation:
    """Explain where an agent's greedy policy loses return to the optimum.

    ``evaluator`` is the result of `exact_evaluator` for the spec of its run.

    Raises:
        UserError: where the agent's policy cannot be evaluated in all states, or the environment is
            too large.
    """
    from rl_yardstick.agents.policies import why_not_exact

    if reason := evaluator.obstacle(agent) or why_not_exact(agent, evaluator.observations):
        raise UserError(f"{spec.algo} cannot be explained: {reason}")
    policy = evaluator.policy(agent, deterministic=True)
    with closing(make_single_env(spec)) as env:
        return explanation_of_policy(env, evaluator, policy, (spec, agent))


def explanation_of_policy(
    env: gym.Env[Any, Any],
    evaluator: ExactEvaluator,
    policy: NDArray[Any],
    learner: tuple[TrainSpec, BaseAlgorithm] | None = None,
) -> Explanation:
    """As `explanation`, of a policy in a form of `mdp.evaluation`, on the evaluator's environment.

    Without a ``learner``, a spec and its agent, the explanation has no parts and no proposals.
    """
    try:
        split = gap_by_state(evaluator.model, policy, evaluator.horizon)
    except ValueError as error:
        what = "this" if learner is None else f"{learner[0].algo} on {learner[0].env_id}"
        raise UserError(f"{what} cannot be explained: {error}") from error
    explained = Explanation(
        optimum=split.optimum,
        value=split.value,
        score=evaluator.yardstick.score(split.value),
        ending=evaluator.ending(policy),
        losses=split.losses,
        n_states=int((split.losses > 0).sum()),
    )
    if explained.is_optimal:
        return explained
    found = Found(env, evaluator, policy, split, learner)
    alike = found.alike()
    explained = replace(
        explained,
        parts=found.parts(),
        states=found.states(),
        repairs=() if alike else found.repairs(),
        discount=None if found.task is None else found.task.discount,
        own_gap=found.own_gap(),
        is_caught=found.is_caught(),
        looks_alike=bool(alike),
    )
    if not explained.is_concentrated:
        explained = replace(explained, road=alike or found.road())
    if learner is None:
        return explained
    from rl_yardstick.diagnosis.proposals import proposals

    return replace(explained, proposals=proposals(learner[0], found, explained.parts))


def _task(spec: TrainSpec, agent: BaseAlgorithm, evaluator: ExactEvaluator) -> Task | None:
    """The agent's objective; None where it is unknown, too large, or of another shape."""
    from rl_yardstick.agents.planning import PlanningAgent, RandomAgent
    from rl_yardstick.pipeline.evaluation.critics import learns_exploring_values

    discount, shape = getattr(agent, "gamma", None), evaluator.model.prob.shape
    if isinstance(agent, PlanningAgent | RandomAgent) or not isinstance(discount, int | float):
        return None
    with closing(make_single_env(spec, training=True)) as env:
        model = transition_model(env)
    if model is None or model.prob.shape != shape or model.prob.size > MOST_OUTCOMES:
        return None
    epsilon = 0.0
    explores = learns_exploring_values(spec, agent)
    if explores and getattr(agent, "exploration", "") == "epsilon_greedy":
        epsilon = float(getattr(agent, "exploration_rate", 0.0))
    lived = _noisy(model, epsilon) if epsilon > 0 else model
    try:
        values = [policy_iteration(each, discount).action_values for each in (model, lived)]
    except ValueError:  # without a discount, where episodes need not end
        return None
    return Task(model, float(discount), epsilon, lived, *values)


class Found:
    """The analysis of one agent's gap."""

    def __init__(
        self,
        env: gym.Env[Any, Any],
        evaluator: ExactEvaluator,
        policy: NDArray[Any],
        split: GapByState,
        learner: tuple[TrainSpec, BaseAlgorithm] | None,
    ) -> None:
        self.evaluator, self.split, self.policy = evaluator, split, policy
        self.model, self.horizon = evaluator.model, evaluator.horizon
        self.place = partial(state_name, env, evaluator.layout)
        known = action_names(env)
        more = (f"action {action}" for action in range(len(known), self.model.n_actions))
        self.actions = (*known, *more)
        # the likeliest action at the first step, shape (S,)
        chances = policy_matrix(self.model, canonical_policy(self.model, policy))
        self.taken: Ints = chances.argmax(axis=1)
        self.groups = None
        if evaluator.scale is not None:
            self.groups = observation_groups(evaluator.observations, self.model.reachable)
        # the values that it acts by, (S, A) or (S,); a softmax does not act by its values
        self.beliefs: Floats | None = None
        # how often each pair of state and action of a table was updated, shape (S, A)
        self.updates: Ints | None = None
        self.task = None if learner is None else _task(*learner, evaluator)
        if learner is None:
            return
        from rl_yardstick.agents.linear.policy_gradients import SoftmaxAlgorithm
        from rl_yardstick.agents.policies import own_values

        self.agent: Any = learner[1]
        if not isinstance(self.agent, SoftmaxAlgorithm):
            self.beliefs = own_values(self.agent, evaluator.observations)
        counts = getattr(self.agent.policy, "visit_counts", None)
        if counts is not None and evaluator.observations.ndim == 1:
            summed: Ints = counts.numpy().sum(axis=0)[evaluator.observations]
            self.updates = summed if summed.any() else None

    # --- parts ------------------------------------------------------------------------------------

    def parts(self) -> tuple[Part, ...]:
        """The handicaps between the optimum and the agent, in their order."""
        task, scale = self.task, self.evaluator.scale
        if task is None:
            return ()
        # The part that leads to each policy, its return, and what it is.
        told = f"the best policy for discount {task.discount:g}"
        policies = [("objective", self.best_of(task.for_discount), told)]
        if task.epsilon > 0:
            told = f"the best policy that explores with epsilon {task.epsilon:g}"
            policies.append(("exploring", self.best_of(task.own_values), told))
        if scale is not None and scale.best is not None:
            told = "the best memoryless policy"
            told += "" if scale.best.lower == scale.best.upper else " found"
            policies.append(("not observable", scale.best.lower, told))
        last = "learning"
        if self.groups is None and self.beliefs is not None:
            policies += self._of_values(task, self.beliefs)
            last = "not settled"
        found, reached, own = [], self.split.optimum, self.split.value
        for name, value, meaning in policies:
            # A policy that is worse than the agent itself makes no part.
            if value >= own - ROUNDING * max(1.0, abs(value)):
                found.append(Part(name, reached - value, f"{meaning} returns {value:.4g}"))
                reached = value
        if any(part.name == "not settled" for part in found):
            last = "look-ahead"
        return (*found, Part(last, reached - own, f"the agent itself returns {own:.4g}"))

    def _of_values(self, task: Task, beliefs: Floats) -> Iterator[tuple[str, float, str]]:
        """The policies of an agent that has values for each state."""
        values = beliefs if beliefs.ndim == 1 else beliefs.max(axis=1)
        masks = self.evaluator.masks
        if self.updates is not None:
            n_tried = int((self.updates > 0)[self.model.reachable].sum())
            n_pairs = int(self.model.reachable.sum()) * self.model.n_actions
            told = f"planning on the {n_tried:,} of {n_pairs:,} pairs that it tried"
            tried = (self.updates > 0) & (True if masks is None else masks)
            yield "never tried", self._planned_on(tried, task, values), told
        if task.epsilon > 0 and beliefs.ndim == 2:
            values = (1 - task.epsilon) * values + task.epsilon * beliefs.mean(axis=1)
        ahead = task.model.expected_reward + task.discount * expected_next(task.model, values)
        if masks is not None:
            ahead = np.where(masks, ahead, -np.inf)
        seen = policy_return(self.model, ahead.argmax(axis=1), self.horizon).expected_return
        yield "not settled", seen, "one greedy improvement of the agent"

    def best_of(self, values: Floats) -> float:
        """The return of the best policy whose actions are all greedy in some values (S, A)."""
        top = values.max(axis=1, keepdims=True)
        greedy = values >= top - TIE * np.maximum(1.0, np.abs(top))
        return finite_horizon_optimum(self.model, self.horizon, mask=greedy).start_value

    def _planned_on(self, tried: Bools, task: Task, values: Floats) -> float:
        """The return of the best policy that takes only tried actions, bool of shape (S, A).

        In states without a tried action, the agent's own value and action are kept.
        """
        model, unknown = task.lived, np.asarray(~tried.any(axis=1))
        reward = np.where(unknown[:, None, None], values[:, None, None], model.reward)
        ends = model.terminated | unknown[:, None, None]
        known = replace(model, terminated=ends, reward=reward, reward_variance=None)
        try:
            plan = policy_iteration(known, task.discount, mask=tried | unknown[:, None])
        except ValueError:  # without a discount, where tried actions may never end the episode
            return self.split.value
        taken = np.eye(self.model.n_actions, dtype=np.bool_)[self.taken]
        allowed = np.where(unknown[:, None], taken, tried)
        return self.best_of(np.where(allowed, plan.action_values, -np.inf))

    # --- in its own objective ---------------------------------------------------------------------

    def own_gap(self) -> float | None:
        """The gap at the start in its own objective, without a time limit; None if unknown."""
        task = self.task
        if task is None or task.discount >= 1:
            return None
        own = policy_return(task.lived, self.taken, None, task.discount).expected_return
        return max(float(task.lived.initial @ task.own_values.max(axis=1)) - own, 0.0)

    # --- on the way -------------------------------------------------------------------------------

    @cached_property
    def direct(self) -> Ints:
        """The best policy for a discount just below 1, which wastes no time, shape (S,)."""
        return policy_iteration(self.model, 1 - 0.5 / self.horizon).policy

    def is_caught(self) -> bool:
        """Whether most episodes run out of time, although those of the best policy end."""
        if self.task is None or self.evaluator.out_of_time(self.policy) <= 0.5:
            return False
        return self.evaluator.out_of_time(self.direct) < 0.5

    # --- by state ---------------------------------------------------------------------------------

    def states(self) -> tuple[StateLoss, ...]:
        """The 20 states that lose most, the worst first."""
        split, true, found = self.split, None if self.task is None else self.task.own_values, []
        for state in np.argsort(-split.losses, kind="stable")[:20].tolist():
            pair = [int(self.taken[state]), int(split.action_values[state].argmax())]
            own = [
                None if t is None or t.ndim != 2 or self.groups is not None else t[state, pair]
                for t in (self.beliefs, true, self.updates)
            ]
            known = [None if two is None else tuple(two.tolist()) for two in own]
            loss, visits = float(split.losses[state]), float(split.visits[state])
            does, best = (self.actions[action] for action in pair)
            found.append(StateLoss(state, self.place(state), loss, visits, does, best, *known))
        return tuple(one for one in found if one.loss > 0)

    def repairs(self) -> tuple[tuple[str, float], ...]:
        """The greedy repairs that each regain a share of the gap that is worth a line."""
        found = greedy_repairs(self.model, self.policy, self.horizon, self.split, MOST_STATES)
        reached = [self.split.value, *(repair.value for repair in found)]
        too_little = np.diff(reached) < WORTH_A_LINE * self.split.gap
        n_kept = int(too_little.argmax()) if too_little.any() else len(found)
        return tuple((self.place(repair.state), repair.value) for repair in found[:n_kept])

    def alike(self) -> str:
        """Which states share the observation that the agent sees most; empty where none do."""
        if self.groups is None:
            return ""
        visits = np.bincount(self.groups, self.split.visits)
        counts = np.bincount(self.groups, self.model.reachable)
        most = np.where(counts > 1, visits, -1.0).argmax()
        states = np.flatnonzero((self.groups == most) & self.model.reachable)
        places = "; ".join(map(self.place, states[:MOST_STATES].tolist()))
        more = f" and {len(states) - MOST_STATES} more" if len(states) > MOST_STATES else ""
        return f"it cannot tell {len(states)} states apart: {places}{more}"

    def road(self) -> str:
        """How many states of the best road lead the agent to the end, and its last wrong turn.

        The road follows the likeliest outcomes of `direct` from the likeliest start.
        """
        if self.task is None:
            return ""
        model, evaluator = self.model, self.evaluator
        ends_well = model.terminated if evaluator.success is None else evaluator.success
        reward = (ends_well & model.terminated).astype(np.float64)
        counted = replace(model, reward=reward, reward_variance=None)
        reached = state_values(counted, self.policy, self.horizon)
        planned, taken = self.direct, self.taken
        road = [int(model.initial.argmax())]
        while len(road) < min(self.horizon, model.n_states):
            pair = road[-1], planned[road[-1]]
            likeliest = int(model.prob[pair].argmax())
            state = int(model.next_state[pair][likeliest])
            if model.terminated[pair][likeliest] or state in road:
                break
            road.append(state)
        is_lost = (reached <= SURELY) & (taken != planned)
        is_wrong = is_lost | ~evaluator.optimum[1][np.arange(model.n_states), taken]
        wrong = [place for place in road if is_wrong[place]]
        if not wrong:
            return ""
        n_sure, last = int((reached[road] > SURELY).sum()), wrong[-1]
        does, best = (self.actions[policy[last]] for policy in (taken, planned))
        return (
            f"on the best road of {len(road)} states it reaches the end from {n_sure}; its last "
            f"wrong turn is at {self.place(last)}: {does}, where {best} is best"
        )


def _noisy(model: TransitionModel, epsilon: float) -> TransitionModel:
    """The model in which a uniformly random action is taken instead with probability epsilon.

    Its optimal policy is the best epsilon-soft one (Sutton and Barto, section 5.4).
    """
    n_states, n_actions, _ = model.prob.shape

    def both(array: NDArray[Any]) -> NDArray[Any]:
        random = np.repeat(array.reshape(n_states, 1, -1), n_actions, axis=1)
        return np.concatenate([array, random], axis=2)

    arrays = (model.prob, model.next_state, model.reward, model.terminated)
    prob, next_state, reward, terminated = map(both, arrays)
    prob[:, :, : model.n_outcomes] *= 1 - epsilon
    prob[:, :, model.n_outcomes :] *= epsilon / n_actions
    return TransitionModel(prob, next_state, reward, terminated, model.initial)
