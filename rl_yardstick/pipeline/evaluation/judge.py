"""Chooses how a training's agent is evaluated: exactly, over histories, or by episodes.

Agents with memory are evaluated exactly over all possible histories of observations. A history is
the sequence of observations since the episode began. It determines a greedy agent's action, so the
histories of a policy form a tree that branches by the next observation. The evaluation expands this
tree step by step, with the probability of each state in each history. It merges histories with
equal memory (for stacked observations, equal last observations), and omits none, however
improbable. If there are too many histories, episodes are sampled instead.
"""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from rl_yardstick.agents import policies
from rl_yardstick.agents.plain import PlainAgent
from rl_yardstick.agents.planning import RandomAgent
from rl_yardstick.mdp.memoryless import observation_groups
from rl_yardstick.mdp.transition_model import Ints
from rl_yardstick.pipeline.environments import make_envs, make_single_env, remembers
from rl_yardstick.pipeline.evaluation.exact import (
    ExactEvaluator,
    evaluator_of_single,
    exact_evaluator,
    model_refusal,
)
from rl_yardstick.pipeline.evaluation.sampled import STAGES, SampledEvaluator
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, Yardstick
from rl_yardstick.pipeline.spec import TrainSpec


class Judge:
    """Evaluates one agent, and prints why it is judged as it is.

    Attributes:
        exact: the exact evaluator; None if episodes are sampled or histories followed.
        env: the evaluation environments.
        evaluator: maps the agent to an `Evaluation`.
        refusal: why the environment's own model was rejected; None if it was not.
    """

    def __init__(self, spec: TrainSpec, agent: BaseAlgorithm, console: Console) -> None:
        exact = None if policies.has_memory(agent) else exact_evaluator(spec)
        scale, note, n_envs = None, None, 1
        if exact is not None:
            obstacle, note = exact.obstacle(agent), exact.scale and exact.scale.note
            if reason := obstacle or policies.why_not_exact(agent, exact.observations):
                note = f"evaluations are sampled, not exact: {reason}"
                # A user's agent that cannot be queried in all states may have memory.
                scale, exact = exact.yardstick if obstacle else _scale_of_memory(exact), None
        world = None if exact is not None else world_of_memory(spec, agent)
        is_plain = isinstance(agent, PlainAgent)  # and may remember
        if exact is None and not is_plain and policies.is_of_library(agent.predict.__module__):
            n_envs = min(spec.n_eval_envs, spec.eval_episodes or STAGES[0])  # one for each episode
        self.exact, self.env = exact, make_envs(spec, n_envs)
        self.evaluator: Any = exact
        if world is not None:
            note = "evaluations are exact, over all histories of observations, while those are few"
            self.evaluator = HistoryEvaluator(spec, self.env, world)
        elif exact is None:
            self.evaluator = SampledEvaluator(spec, self.env, scale)
        self.refusal = None if exact is not None else model_refusal(spec)
        if exact is not None and exact.found is not None:
            states = f"{exact.model.n_states:,} states"
            notes = "; ".join([f"the exact model was found: {states}", *exact.found.notes])
            console.print(notes, style="dim", markup=False, highlight=False)
        if note := note or (self.refusal and f"{self.refusal}; figures are sampled"):
            console.print(note, style="dim", markup=False, highlight=False)


# --- histories ------------------------------------------------------------------------------------

# Histories at one step, and in all: a second or two. Each call of `predict` counts as at least 10.
MOST_HISTORIES, MOST_IN_ALL, LEAST_AT_ONCE = 3_000, 30_000, 10


def world_of_memory(spec: TrainSpec, agent: BaseAlgorithm) -> ExactEvaluator | None:
    """The exact evaluator of an agent with memory; None if histories cannot be followed."""
    is_covered = spec.normalize is not None or bool(spec.vec_env_wrapper)
    # The memory of other agents has an unknown form, and some sample their actions.
    is_known = policies.is_of_library(type(agent).__module__) and not isinstance(agent, RandomAgent)
    if is_covered or not is_known or not (policies.has_memory(agent) or remembers(spec)):
        return None
    return evaluator_of_single(spec)


def _scale_of_memory(world: ExactEvaluator) -> Yardstick:
    return world.yardstick if world.scale is None else world.scale.yardstick(with_memory=True)


class HistoryEvaluator(SampledEvaluator):
    """Evaluates an agent with memory by histories, or by episodes if there are too many."""

    def __init__(self, spec: TrainSpec, env: VecEnv, world: ExactEvaluator) -> None:
        super().__init__(spec, env, _scale_of_memory(world))
        self.spec, self.world = spec, world
        self._was_exact = False

    def can_afford(self, model: BaseAlgorithm, n_episodes: int) -> bool:
        """Whether the training has done enough steps; always, if the last evaluation was exact."""
        may_sample = super().can_afford(model, n_episodes)
        return self._was_exact or may_sample

    def _evaluate(self, model: BaseAlgorithm, *limits: Any) -> Evaluation:
        found = by_histories(self.spec, model, self.world)
        self._was_exact = found is not None
        return found or super()._evaluate(model, *limits)


class _Memory:
    """The memory of an agent in each of n histories."""

    def __init__(self, agent: BaseAlgorithm, spec: TrainSpec) -> None:
        self.agent, self.n_stacked = agent, spec.frame_stack or 1
        with closing(make_single_env(spec)) as single:
            self.space: Any = single.observation_space
        self.state: tuple[NDArray[Any], ...] | None = None  # shapes (layers, n, units)
        self.stack: NDArray[Any] | None = None  # shape (n, ...)

    def actions(self, observations: NDArray[Any], is_first: bool) -> Ints:
        """Add observations to the memory; returns the greedy action in each history."""
        n = len(observations)
        if self.n_stacked > 1:
            stacked = StackedObservations(n, self.n_stacked, self.space)
            if self.stack is None:
                observations = np.asarray(stacked.reset(observations))
            else:
                stacked.stacked_obs = self.stack
                infos: list[dict[str, Any]] = [{} for _ in range(n)]
                updated, _ = stacked.update(observations, np.zeros(n, np.bool_), infos)
                observations = np.asarray(updated)
            self.stack = observations.copy()
        first = np.full(n, is_first)
        actions, state = self.agent.predict(observations, self.state, first, deterministic=True)
        self.state = None if state is None else tuple(np.asarray(part) for part in state)
        return np.asarray(actions, dtype=np.int64).reshape(n)

    def keep(self, places: Ints) -> None:
        """Continue with the histories at these indices, which may repeat."""
        if self.stack is not None:
            self.stack = self.stack[places]
        if self.state is not None:
            self.state = tuple(part[:, places] for part in self.state)

    def keys(self) -> NDArray[Any]:
        """The memory in each history, as a row of bytes."""
        parts = [] if self.stack is None else [self.stack]
        parts += [np.swapaxes(part, 0, 1) for part in self.state or ()]
        rows = [np.ascontiguousarray(part.reshape(len(part), -1)).view(np.uint8) for part in parts]
        return np.concatenate(rows, axis=1)


def by_histories(spec: TrainSpec, agent: BaseAlgorithm, world: ExactEvaluator) -> Evaluation | None:
    """The exact evaluation of an agent with memory; None if there are too many histories."""
    model, variance = world.model, world.model.reward_variance
    groups = observation_groups(world.observations, model.reachable)
    groups = np.arange(model.n_states) if groups is None else groups
    if policies.takes_masks(agent):  # masks reveal more of the state than observations
        return None
    memory = _Memory(agent, spec)
    # Per history and state: the probability p, p x mean return, and p x mean squared return so far.
    state = np.flatnonzero(model.initial)
    history, first = _numbered(groups[state])
    moments = np.stack([model.initial[state], 0 * state, 0 * state]).astype(np.float64)
    # Totals of return, squared return, length and success, each times its probability.
    first_states, totals, n_asked = state[first], np.zeros(4), 0
    for step in range(world.horizon):
        n_asked += max(len(first_states), LEAST_AT_ONCE)
        if len(first_states) > MOST_HISTORIES or n_asked > MOST_IN_ALL:
            return None
        taken = memory.actions(world.observations[first_states], is_first=step == 0)
        rows = state, taken[history]
        totals[2] += moments[0].sum()
        at, outcome = np.nonzero(model.prob[rows] > 0)
        entry = state[at], rows[1][at], outcome
        weight, reward = model.prob[entry], model.reward[entry]
        squared = reward**2 + (0.0 if variance is None else variance[entry])
        p, mean, second = moments[:, at]
        after = weight * np.stack([p, mean + reward * p, second + 2 * reward * mean + squared * p])
        if world.success is not None:
            totals[3] += after[0] @ world.success[entry]
        goes_on = ~model.terminated[entry] & (step < world.horizon - 1)
        totals[:2] += after[1:, ~goes_on].sum(axis=1)
        if not goes_on.any():
            break
        state, moments = model.next_state[entry][goes_on].astype(np.int64), after[:, goes_on]
        # A new history for each old one and each next observation; then histories with the same
        # memory and the same next observation are merged.
        parent = history[at][goes_on]
        history, first = _numbered(np.stack([parent, groups[state]], axis=1))
        parents, seen = parent[first], groups[state[first]]
        remembered = memory.keys()[parents]
        alike, kept = _numbered(np.concatenate([remembered, seen[:, None].view(np.uint8)], axis=1))
        memory.keep(parents[kept])
        pairs, places = _numbered(np.stack([alike[history], state], axis=1))
        moments = np.stack([np.bincount(pairs, each) for each in moments])
        first_states = state[first[kept]]
        history, state = alike[history][places], state[places]
    std = float(np.sqrt(max(totals[1] - totals[0] ** 2, 0.0)))
    successes = None if world.success is None else totals[3:]
    return Evaluation(totals[:1], totals[2:3], successes, std, _scale_of_memory(world))


def _numbered(rows: NDArray[Any]) -> tuple[Ints, Ints]:
    """The index of each row among the unique rows, and the first position of each unique row."""
    rows = np.ascontiguousarray(rows.reshape(len(rows), -1))
    as_bytes = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, numbers = np.unique(as_bytes, return_index=True, return_inverse=True)
    return numbers.reshape(-1).astype(np.int64), first.astype(np.int64)
