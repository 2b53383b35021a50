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

from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.agents.planning import PlanningAgent
from rl_yardstick.agents.reference import RandomAgent
from rl_yardstick.diagnosis.proposals import proposals
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
from rl_yardstick.mdp.gaps import (
    GapByState,
    first_differences,
    gap_by_state,
    greedy_repairs,
)
from rl_yardstick.mdp.memoryless import observation_groups
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.advice import how_episodes_end, still_running
from rl_yardstick.pipeline.evaluation.critics import learns_exploring_values
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.evaluation.policies import believed_values
from rl_yardstick.pipeline.spec import TrainSpec

# The largest model to plan in for an agent's objective, which takes about a second.
MOST_OUTCOMES = 500_000
# Action values within this of the best, relative to it, count as ties.
TIE = 1e-9
# States are named where at most this many of them make up this share of the gap.
MOST_STATES, MOST_OF_GAP = 3, 0.5
# The probability of an end from which on it counts as sure.
SURELY = 0.99
# Repairs that regain less than this share of the gap are not worth a line.
WORTH_A_LINE = 0.05
# Returns within this of each other, relative to them, count as equal.
ROUNDING = 1e-9


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


class _Task(NamedTuple):
    """The objective that the agent was trained for."""

    model: TransitionModel  # the model of the training environment
    discount: float
    epsilon: float  # exploration rate, if the agent learns the values of exploring, else 0
    lived: TransitionModel  # the model with these random actions


def explanation(spec: TrainSpec, agent: BaseAlgorithm, evaluator: ExactEvaluator) -> Explanation:
    """Explain where an agent loses return to the optimum.

    Args:
        spec: the spec of the agent's run.
        agent: the agent, whose greedy policy is explained.
        evaluator: the result of `exact_evaluator` for the spec.

    Raises:
        UserError: where the agent's policy cannot be evaluated in all states, or the environment is
            too large.
    """
    if reason := evaluator.obstacle(agent):
        raise UserError(f"{spec.algo} cannot be explained: {reason}")
    policy = evaluator.policy(agent, deterministic=True)
    try:
        split = gap_by_state(evaluator.model, policy, evaluator.horizon)
    except ValueError as error:
        raise UserError(f"{spec.algo} on {spec.env_id} cannot be explained: {error}") from error
    explained = Explanation(
        optimum=split.optimum,
        value=split.value,
        score=evaluator.yardstick.score(split.value),
        ending=how_episodes_end(evaluator, policy),
        losses=split.losses,
        n_states=int((split.losses > 0).sum()),
    )
    if explained.is_optimal:
        return explained
    task = _task(spec, agent, evaluator)
    found = Found(evaluator, agent, policy, split, task)
    with closing(make_single_env(spec)) as env:
        words = _Words(env, evaluator)
        alike = None if found.groups is None else found.alike(words)
        explained = replace(
            explained,
            parts=found.parts(),
            states=found.states(words),
            repairs=() if alike else found.repairs(words),
            discount=None if task is None else task.discount,
            own_gap=found.own_gap(),
            is_caught=found.is_caught(),
            looks_alike=alike is not None,
        )
        if alike is not None or not explained.is_concentrated:
            explained = replace(explained, road=alike or found.road(words))
    return replace(explained, proposals=proposals(spec, found, explained.parts))


def _task(spec: TrainSpec, agent: BaseAlgorithm, evaluator: ExactEvaluator) -> _Task | None:
    """The agent's objective; None where it is unknown, too large, or of another shape."""
    discount = getattr(agent, "gamma", None)
    if isinstance(agent, PlanningAgent | RandomAgent) or not isinstance(discount, int | float):
        return None
    with closing(make_single_env(spec, training=True)) as env:
        model = transition_model(env)
    if model is None or model.prob.shape != evaluator.model.prob.shape:
        return None
    if model.prob.size > MOST_OUTCOMES:
        return None
    epsilon = 0.0
    explores = learns_exploring_values(spec, agent)
    if explores and getattr(agent, "exploration", "") == "epsilon_greedy":
        epsilon = float(getattr(agent, "exploration_rate", 0.0))
    lived = _noisy(model, epsilon) if epsilon > 0 else model
    return _Task(model, float(discount), epsilon, lived)


class _Words:
    """Names of states and actions."""

    def __init__(self, env: gym.Env[Any, Any], evaluator: ExactEvaluator) -> None:
        self._env, self._layout = env, evaluator.layout
        self._actions = action_names(env)

    def place(self, state: int) -> str:
        """The name of a state."""
        return state_name(self._env, self._layout, state)

    def action(self, action: int) -> str:
        """The name of an action."""
        return self._actions[action] if action < len(self._actions) else f"action {action}"


class Found:
    """The analysis of one agent's gap."""

    def __init__(
        self,
        evaluator: ExactEvaluator,
        agent: BaseAlgorithm,
        policy: NDArray[Any],
        split: GapByState,
        task: _Task | None,
    ) -> None:
        self.evaluator, self.split, self.task, self.policy = evaluator, split, task, policy
        self.model, self.horizon = evaluator.model, evaluator.horizon
        self.agent, self.taken = agent, _first_actions(evaluator.model, policy, evaluator.horizon)
        self.groups = None
        if evaluator.scale is not None:
            self.groups = observation_groups(evaluator.observations, self.model.reachable)
        self.beliefs = believed_values(agent, evaluator.observations)
        self.updates = _updates(agent, evaluator.observations)
        # optimal action values for its discount, and of its own objective, shape (S, A)
        self.for_discount: Floats | None = None
        self.own_values: Floats | None = None
        if task is not None:
            try:
                self.for_discount = policy_iteration(task.model, task.discount).action_values
                self.own_values = policy_iteration(task.lived, task.discount).action_values
            except ValueError:  # without a discount, where episodes need not end
                self.task = None

    # --- parts ------------------------------------------------------------------------------------

    def parts(self) -> tuple[Part, ...]:
        """The handicaps between the optimum and the agent, in their order."""
        task = self.task
        if task is None or self.for_discount is None or self.own_values is None:
            return ()
        found: list[Part] = []
        reached = self.split.optimum

        def down_to(value: float, name: str, meaning: str) -> None:
            nonlocal reached
            # A policy that is worse than the agent itself makes no part.
            if value >= self.split.value - ROUNDING * max(1.0, abs(value)):
                found.append(Part(name, reached - value, meaning))
                reached = value

        best = self.best_of(self.for_discount)
        known = f"the best policy for discount {task.discount:g} returns {best:.4g}"
        down_to(best, "objective", known)
        if task.epsilon > 0:
            best = self.best_of(self.own_values)
            told = f"the best policy that explores with epsilon {task.epsilon:g}"
            down_to(best, "exploring", f"{told} returns {best:.4g}")
        if self.groups is not None:
            best_seen = None if self.evaluator.scale is None else self.evaluator.scale.best
            if best_seen is not None:
                is_best = best_seen.lower == best_seen.upper
                told = f"the best memoryless policy{'' if is_best else ' found'}"
                told += f" returns {best_seen.lower:.4g}"
                down_to(best_seen.lower, "not observable", told)
        elif self.beliefs is not None:
            self._of_values(down_to, task)
        has_values = self.groups is None and self.beliefs is not None
        looked = any(part.name == "not settled" for part in found)
        last = "look-ahead" if looked else "not settled" if has_values else "learning"
        down_to(self.split.value, last, f"the agent itself returns {self.split.value:.4g}")
        return tuple(found)

    def _of_values(self, down_to: Any, task: _Task) -> None:
        """The parts of an agent that has values for each state."""
        assert self.beliefs is not None
        if self.updates is not None:
            planned = self._planned_on_tried(task.lived, task.discount)
            n_tried = int((self.updates > 0)[self.model.reachable].sum())
            n_pairs = int(self.model.reachable.sum()) * self.model.n_actions
            told = f"planning on the {n_tried:,} of {n_pairs:,} pairs that it tried"
            down_to(planned, "never tried", f"{told} returns {planned:.4g}")
        values = self.beliefs if self.beliefs.ndim == 1 else self.beliefs.max(axis=1)
        if task.epsilon > 0 and self.beliefs.ndim == 2:
            values = (1 - task.epsilon) * values + task.epsilon * self.beliefs.mean(axis=1)
        ahead = _looked_ahead(task.model, task.discount, values)
        if self.evaluator.masks is not None:
            ahead = np.where(self.evaluator.masks, ahead, -np.inf)
        seen = self._worth(ahead.argmax(axis=1))
        down_to(seen, "not settled", f"one exact look ahead with its own values returns {seen:.4g}")

    def best_of(self, values: Floats) -> float:
        """The return of the best policy whose actions are all greedy in some values (S, A)."""
        top = values.max(axis=1, keepdims=True)
        greedy = values >= top - TIE * np.maximum(1.0, np.abs(top))
        return finite_horizon_optimum(self.model, self.horizon, mask=greedy).start_value

    def _worth(self, policy: Ints) -> float:
        return policy_return(self.model, policy, self.horizon).expected_return

    def _planned_on_tried(self, model: TransitionModel, discount: float) -> float:
        """The return of the best policy that takes only tried actions.

        In states without a tried action, the agent's own value and action are kept.
        """
        assert self.updates is not None
        assert self.beliefs is not None
        tried: Bools = self.updates > 0
        if self.evaluator.masks is not None:
            tried &= self.evaluator.masks
        unknown: Bools = np.asarray(~tried.any(axis=1))
        ends = model.terminated | unknown[:, None, None]
        values = self.beliefs if self.beliefs.ndim == 1 else self.beliefs.max(axis=1)
        reward = np.where(unknown[:, None, None], values[:, None, None], model.reward)
        known = replace(model, terminated=ends, reward=reward, reward_variance=None)
        try:
            plan = policy_iteration(known, discount, mask=tried | unknown[:, None])
        except ValueError:  # without a discount, where tried actions may never end the episode
            return self.split.value
        taken = np.eye(self.model.n_actions, dtype=np.bool_)[self.taken]
        allowed = np.where(unknown[:, None], taken, tried)
        return self.best_of(np.where(allowed, plan.action_values, -np.inf))

    # --- in its own objective ---------------------------------------------------------------------

    def own_gap(self) -> float | None:
        """The gap at the start in its own objective, without a time limit; None if unknown."""
        task = self.task
        if task is None or self.own_values is None or task.discount >= 1:
            return None
        best = float(task.lived.initial @ self.own_values.max(axis=1))
        own = policy_return(task.lived, self.taken, None, task.discount)
        return max(best - own.expected_return, 0.0)

    # --- on the way -------------------------------------------------------------------------------

    @cached_property
    def direct(self) -> Ints:
        """The best policy for a discount just below 1, which wastes no time, shape (S,)."""
        return policy_iteration(self.model, 1 - 0.5 / self.horizon).policy

    def is_caught(self) -> bool:
        """Whether most episodes run out of time, although those of the best policy end."""
        if self.task is None or still_running(self.evaluator, self.policy, 1).sum() <= 0.5:
            return False
        return bool(still_running(self.evaluator, self.direct, 1).sum() < 0.5)

    # --- by state ---------------------------------------------------------------------------------

    def states(self, words: _Words, most: int = 20) -> tuple[StateLoss, ...]:
        """The states that lose most, the worst first."""
        losses = self.split.losses
        order = np.argsort(-losses, kind="stable")[:most]
        return tuple(self._state(int(state), words) for state in order if losses[state] > 0)

    def _state(self, state: int, words: _Words) -> StateLoss:
        split = self.split
        pair = [int(self.taken[state]), int(split.action_values[state].argmax())]

        def of(table: NDArray[Any] | None) -> tuple[Any, Any] | None:
            if table is None or table.ndim != 2 or self.groups is not None:
                return None
            first, second = table[state, pair].tolist()
            return first, second

        return StateLoss(
            state=state,
            name=words.place(state),
            loss=float(split.losses[state]),
            visits=float(split.visits[state]),
            action=words.action(pair[0]),
            best=words.action(pair[1]),
            believed=of(self.beliefs),
            true=of(self.own_values),
            updates=of(self.updates),
        )

    def repairs(self, words: _Words) -> tuple[tuple[str, float], ...]:
        """The greedy repairs that each regain a share of the gap that is worth a line."""
        found = greedy_repairs(self.model, self.policy, self.horizon, self.split, MOST_STATES)
        reached = [self.split.value, *(repair.value for repair in found)]
        too_little = np.diff(reached) < WORTH_A_LINE * self.split.gap
        n_kept = int(too_little.argmax()) if too_little.any() else len(found)
        return tuple((words.place(repair.state), repair.value) for repair in found[:n_kept])

    def alike(self, words: _Words) -> str:
        """The states of the observation that the agent sees most, where several states share it."""
        assert self.groups is not None
        visits = np.bincount(self.groups, self.split.visits)
        counts = np.bincount(self.groups, self.model.reachable)
        most = np.where(counts > 1, visits, -1.0).argmax()
        states = np.flatnonzero((self.groups == most) & self.model.reachable)
        names = "; ".join(words.place(int(state)) for state in states[:MOST_STATES])
        more = f" and {len(states) - MOST_STATES} more" if len(states) > MOST_STATES else ""
        return f"it cannot tell {len(states)} states apart: {names}{more}"

    def road(self, words: _Words) -> str:
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
        road, state = [int(model.initial.argmax())], 0
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
        does, best = (words.action(int(policy[last])) for policy in (taken, planned))
        return (
            f"on the best road of {len(road)} states it reaches the end from {n_sure}; its last "
            f"wrong turn is at {words.place(last)}: {does}, where {best} is best"
        )


# --- two agents -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """A state in which two agents first act differently."""

    state: int
    name: str
    met: float  #: the probability that an episode's first difference is there
    gain: float  #: what the better agent gains by it, in return per episode
    actions: tuple[str, str]  #: the actions of the better and of the worse agent


@dataclass(frozen=True)
class Parting:
    """Where the policies of two agents first part, the one with the higher return first."""

    names: tuple[str, str]
    difference: float  #: the difference of the returns, at least 0; gains sum to it
    met: float  #: the probability that an episode has a difference
    places: tuple[Place, ...]  #: at most 20, the largest gains or losses first

    def as_data(self) -> dict[str, Any]:
        """The parting as JSON."""
        return {**vars(self), "places": [vars(place) for place in self.places]}


Side = tuple[TrainSpec, BaseAlgorithm, ExactEvaluator]


def parting(one: Side, other: Side) -> Parting:
    """Where the policies of two agents on one environment first part, and the cost of it.

    Raises:
        UserError: where a policy cannot be evaluated in all states, or the model is too large.
    """
    evaluator = one[2]
    model, horizon = evaluator.model, evaluator.horizon
    policies = []
    for spec, agent, of in (one, other):
        if reason := of.obstacle(agent):
            raise UserError(f"{spec.algo} cannot be compared: {reason}")
        policies.append(of.policy(agent, deterministic=True))
    returns = [policy_return(model, policy, horizon).expected_return for policy in policies]
    names = [spec.algo for spec, _, _ in (one, other)]
    if names[0] == names[1]:
        names = [f"{name} {number}" for number, name in enumerate(names, 1)]
    better, worse = (0, 1) if returns[0] >= returns[1] else (1, 0)
    try:
        found = first_differences(model, policies[better], policies[worse], horizon)
    except ValueError as error:
        raise UserError(f"{one[0].env_id}: {error}") from error
    taken = [_first_actions(model, policies[side], horizon) for side in (better, worse)]
    order = np.argsort(-np.abs(found.gains), kind="stable")[:20]
    with closing(make_single_env(one[0])) as env:
        words = _Words(env, evaluator)
        places = [
            Place(
                state=int(state),
                name=words.place(int(state)),
                met=float(found.met[state]),
                gain=float(found.gains[state]),
                actions=(words.action(int(taken[0][state])), words.action(int(taken[1][state]))),
            )
            for state in order
            if found.met[state] > 0
        ]
    return Parting(
        names=(names[better], names[worse]),
        difference=returns[better] - returns[worse],
        met=float(found.met.sum()),
        places=tuple(places),
    )


def _first_actions(model: TransitionModel, policy: NDArray[Any], horizon: int) -> Ints:
    """The likeliest action of a policy at the first step, shape (S,)."""
    canonical = canonical_policy(model, policy)
    likeliest: Ints = policy_matrix(model, canonical).argmax(axis=1)
    return likeliest


def _updates(agent: BaseAlgorithm, observations: NDArray[Any]) -> Ints | None:
    """How often each pair of state and action was updated, shape (S, A), of agents with tables."""
    counts = getattr(agent.policy, "visit_counts", None)
    if counts is None or observations.ndim != 1:
        return None
    summed: Ints = counts.numpy().sum(axis=0)[observations]
    return summed if summed.any() else None


def _looked_ahead(model: TransitionModel, discount: float, values: Floats) -> Floats:
    """Action values (S, A) by one exact step from values (S,)."""
    following = np.where(model.terminated, 0.0, values[model.next_state])
    later: Floats = np.einsum("sak,sak->sa", model.prob, following)
    return model.expected_reward + discount * later


def _noisy(model: TransitionModel, epsilon: float) -> TransitionModel:
    """The model in which a uniformly random action is taken instead with probability epsilon.

    Its optimal policy is the best epsilon-soft one (Sutton and Barto, section 5.4).
    """
    n_states, n_actions, _ = model.prob.shape

    def both(array: NDArray[Any]) -> NDArray[Any]:
        random = np.repeat(array.reshape(n_states, 1, -1), n_actions, axis=1)
        return np.concatenate([array, random], axis=2)

    prob = both(model.prob)
    n_own = model.n_outcomes
    prob[:, :, :n_own] *= 1 - epsilon
    prob[:, :, n_own:] *= epsilon / n_actions
    return TransitionModel(
        prob, both(model.next_state), both(model.reward), both(model.terminated), model.initial
    )
