"""Computes exact values and actions of an agent in every state of a map, and the optimal ones.

For tables and networks alike, the value of a state is the expected return of the agent's
deterministic policy from there, with the whole time limit left; not the agent's own estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.envs.layout import GridLayout
from rl_yardstick.mdp.evaluation import actions_used
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.files import replacing

# On larger maps, cells are too small to see, and the data too large to store.
MAX_STATES = 2500
# More maps than a slider can resolve.
MAX_MAPS = 400


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
    model, layout = evaluator.model, evaluator.layout
    if layout is None or (policy := best_actions_of(evaluator, agent)) is None:
        return None
    optimal_values, optimal_actions = evaluator.optimum
    return ValueMap(
        layout=layout,
        matters=model.reachable,
        initial=model.initial,
        values=evaluator.values(policy),
        actions=policy[0],
        visited=model.reached_by(actions_used(model, policy)),
        optimal_values=optimal_values,
        optimal_actions=optimal_actions,
        optimal_visited=model.reached_by(optimal_actions),
    )


def best_actions_of(evaluator: ExactEvaluator, agent: BaseAlgorithm) -> Ints | None:
    """Actions at each step and state, (1 or horizon, S); None if random, or on larger maps."""
    if evaluator.model.n_states > MAX_STATES:
        return None
    policy = evaluator.policy(agent, deterministic=True)
    if np.issubdtype(policy.dtype, np.integer):
        return np.atleast_2d(policy).astype(np.int64)
    return policy.argmax(axis=1)[None] if (policy.max(axis=1) == 1).all() else None


class ValueMapRecorder:
    """Records the maps of an agent at its evaluations; on a grid, in the file ``path``.

    The file has `timesteps` (T,), `values` (T, S), `actions` (T, S), `optimal_values` (S,) and
    `optimal_actions` (S, A), as in `ValueMap`. Of too many maps it keeps every 2nd, 4th, ... one.
    """

    def __init__(self, path: Path, evaluator: ExactEvaluator) -> None:
        self.path, self.evaluator = path, evaluator
        # number of the evaluation, time steps, values (S,), actions (S,)
        self.moments: list[tuple[int, int, Floats, Ints]] = []
        self.stride, self.n_units = 1, 0  # evaluations, one in ``stride`` of which is kept

    def count(self, agent: BaseAlgorithm) -> None:
        """Count an evaluation, and record its map if its number is a multiple of the stride."""
        self.n_units += 1
        if self.n_units % self.stride == 0:
            self._append(agent)
        if len(self.moments) > MAX_MAPS:
            self.stride *= 2
            self.moments = [moment for moment in self.moments if moment[0] % self.stride == 0]

    def _append(self, agent: BaseAlgorithm) -> None:
        policy, now = best_actions_of(self.evaluator, agent), agent.num_timesteps
        if policy is None or (self.moments and self.moments[-1][1] == now):
            return
        self.moments.append((self.n_units, now, self.evaluator.values(policy), policy[0]))

    def finish(self, agent: BaseAlgorithm) -> None:
        """Record the map at the end of training, and write all maps."""
        self._append(agent)
        if self.evaluator.layout is None or not self.moments:
            return
        _, timesteps, values, actions = zip(*self.moments, strict=True)
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
