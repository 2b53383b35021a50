"""Computes exact values and actions of an agent in every state of a map, and the optimal ones.

For tables and networks alike, the value of a state is the expected return of the agent's
deterministic policy from there, with the whole time limit left; not the agent's own estimate.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.envs.layout import GridLayout
from rl_yardstick.mdp.evaluation import actions_used
from rl_yardstick.mdp.graph import reachable_states
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.files import replacing

# On larger maps, cells are too small to see, and the data too large to store.
MAX_STATES = 2500
# More maps than a slider can resolve.
MAX_MAPS = 400
SECONDS_BETWEEN_WRITES = 1.0


@dataclass(frozen=True, eq=False)
class ValueMap:
    """An agent's policy in every state of a grid world, with the optimal one."""

    layout: GridLayout  #: where the states lie on the map
    matters: Bools  #: the reachable states, shape (S,); other states are ignored
    initial: Floats  #: probabilities of the starting states, shape (S,)
    values: Floats  #: the expected return of the agent from each state on, shape (S,)
    actions: Ints  #: the agent's action there at the first step, shape (S,)
    visited: Bools  #: the states that the agent reaches from the start, shape (S,)
    optimal_values: Floats  #: the highest expected return from each state on, shape (S,)
    optimal_actions: Bools  #: the optimal first actions, shape (S, A)
    optimal_visited: Bools  #: the states that optimal actions lead to, shape (S,)

    @property
    def differs(self) -> Bools:
        """The states where the agent's action is not optimal, bool (S,)."""
        chosen = self.optimal_actions[np.arange(len(self.actions)), self.actions]
        return self.matters & ~chosen


def value_map(evaluator: ExactEvaluator, agent: BaseAlgorithm) -> ValueMap | None:
    """The map of an agent with one action per state, on a grid of up to 2500 states; else None."""
    policy = best_actions_of(evaluator, agent) if _can_be_drawn(evaluator) else None
    if policy is None or evaluator.layout is None:
        return None
    model = evaluator.model
    optimal_values, optimal_actions = evaluator.optimum
    return ValueMap(
        layout=evaluator.layout,
        matters=model.reachable,
        initial=model.initial,
        values=evaluator.values(policy),
        actions=policy[0],
        visited=reachable_states(model, actions_used(model, policy)),
        optimal_values=optimal_values,
        optimal_actions=optimal_actions,
        optimal_visited=reachable_states(model, optimal_actions),
    )


def map_refusal(evaluator: ExactEvaluator) -> str | None:
    """Why a grid world has no map; None if it has one, or is no grid world."""
    n_states = evaluator.model.n_states
    if evaluator.layout is None or n_states <= MAX_STATES:
        return None
    return f"no value map: {n_states:,} states, the limit is {MAX_STATES:,}"


def _can_be_drawn(evaluator: ExactEvaluator) -> bool:
    return evaluator.layout is not None and evaluator.model.n_states <= MAX_STATES


def best_actions_of(evaluator: ExactEvaluator, agent: BaseAlgorithm) -> Ints | None:
    """Actions at each step and state, shape (1 or horizon, S); None if the policy is random."""
    policy = evaluator.policy(agent, deterministic=True)
    if np.issubdtype(policy.dtype, np.integer):
        return np.atleast_2d(policy).astype(np.int64)
    return policy.argmax(axis=1)[None] if (policy.max(axis=1) == 1).all() else None


class ValueMapRecorder:
    """Records the maps of an agent over its training in the file ``path``.

    The file has `timesteps` (T,), `values` (T, S), `actions` (T, S), `optimal_values` (S,) and
    `optimal_actions` (S, A), as in `ValueMap`. Of too many maps it keeps every 2nd, 4th, ... one.
    """

    def __init__(self, path: Path, evaluator: ExactEvaluator) -> None:
        self.path = path
        self.evaluator = evaluator
        self._maps: list[tuple[int, Floats, Ints]] = []
        self._calls = 0
        self._stride = 1
        self._last_write = time.monotonic()

    def record(self, agent: BaseAlgorithm, timesteps: int) -> None:
        """Record the map of the current agent after ``timesteps`` steps."""
        if len(self._maps) >= MAX_MAPS:
            self._maps = self._maps[1::2]
            self._stride *= 2
        self._calls += 1
        if self._calls % self._stride:
            return
        self._append(agent, timesteps)
        # Flushing a file to disk takes longer than an evaluation.
        if time.monotonic() - self._last_write > SECONDS_BETWEEN_WRITES:
            self._write()

    def finish(self, agent: BaseAlgorithm, timesteps: int) -> None:
        """Record the map at the end of training, and write all maps that are not written yet."""
        if not self._maps or self._maps[-1][0] != timesteps:
            self._append(agent, timesteps)
        self._write()

    def _append(self, agent: BaseAlgorithm, timesteps: int) -> None:
        policy = best_actions_of(self.evaluator, agent) if _can_be_drawn(self.evaluator) else None
        if policy is not None:
            values = self.evaluator.values(policy)
            self._maps.append((timesteps, values, policy[0]))

    def _write(self) -> None:
        if not self._maps:
            return
        timesteps, values, actions = zip(*self._maps, strict=True)
        optimal_values, optimal_actions = self.evaluator.optimum
        arrays: dict[str, Any] = {
            "timesteps": timesteps,
            "values": values,
            "actions": np.array(actions, np.min_scalar_type(optimal_actions.shape[1] - 1)),
            "optimal_values": optimal_values,
            "optimal_actions": optimal_actions,
        }
        with replacing(self.path) as beside:
            np.savez(beside, **arrays)
        self._last_write = time.monotonic()
