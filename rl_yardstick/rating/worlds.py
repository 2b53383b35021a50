"""The environment on which something is rated: its scale, its tables, and its episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

from rl_yardstick.envs.known_models import time_limit
from rl_yardstick.envs.layout import FREE, START, action_names, grid_layout
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.mdp.transition_model import Bools, Ints
from rl_yardstick.pipeline.environments import EVALUATION_TIME_LIMIT, MISTAKES, make_env
from rl_yardstick.pipeline.errors import UserError, one_line, unknown
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator, evaluator_in
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, bracket_of
from rl_yardstick.rating.tables import Rows, key_of, parts_of

N_EPISODES, SEED = 100, 0  # of a sampled rating
MOST_ROWS = 50_000_000
BINS = ("bins", "low", "high", "dims")
_ARROWS = {(-1, 0): "^", (1, 0): "v", (0, -1): "<", (0, 1): ">"}

Env = gym.Env[Any, Any]


@dataclass(frozen=True, eq=False)
class World:
    """An environment, with its exact evaluator if its model is known."""

    name: str  #: its id, with the arguments that were given
    env: Env
    exact: ExactEvaluator | None
    env_id: str = ""  #: empty for an environment that was given as an object
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def rows(self) -> Rows:
        """The rows of its tables; UserError if observations or actions are not finitely many."""
        env, actions, exact = self.env, self.env.action_space, self.exact
        parts = parts_of(env.observation_space)
        if isinstance(env, DiscretizeObservation):
            parts = [(int(n), 0) for n in env.bins]
        sizes = tuple(size for size, _ in parts or ())
        if not isinstance(actions, spaces.Discrete) or np.prod(sizes, dtype=float) > MOST_ROWS:
            raise UserError(f"{self.name} has too many observations or actions for a table")
        if parts is None:
            fault = f"has observations of shape {env.observation_space.shape}, which are no states"
            given = "--bins bins:10 low:[-2,-3] high:[2,3]"
            raise UserError(f"{self.name} {fault}: give the bins of the table, as in {given}")
        seen = None
        if exact is not None:
            states = np.asarray(exact.observations[exact.model.reachable], np.int64)
            seen = states.reshape(len(states), -1)
        layout, first = grid_layout(env), np.array([first for _, first in parts])
        is_flat = layout is not None and layout.n_states == layout.n_cells
        grid = (layout.n_rows, layout.n_columns) if layout is not None and is_flat else None
        return Rows(self.name, sizes, first, int(actions.n), action_names(env), grid, seen)

    def rows_of_states(self) -> Ints:
        """The row of the observation of each state of the model, shape (S,); 0 for unreachable."""
        assert self.exact is not None
        assert self.rows.seen is not None
        numbers, found = np.zeros(self.exact.model.n_states, np.int64), self.rows.seen
        numbers[self.exact.model.reachable] = self.rows.numbers(found)  # type: ignore[assignment]
        return numbers

    def row_of(self, observation: Any) -> int:
        """The row of one observation."""
        found = self.rows.numbers(np.array([key_of(observation)]))
        assert found is not None
        return int(found[0])

    @cached_property
    def other(self) -> World | None:
        """The same lake, slippery if this one is not, and the other way round; else None."""
        base = self.env.unwrapped
        if not (self.env_id and isinstance(base, FrozenLakeEnv)):
            return None
        slips = any(len(outcomes) > 1 for outcomes in base.P[0].values())
        return world_of(self.env_id, {**self.env_kwargs, "is_slippery": not slips})

    def observed(self) -> dict[int, Any]:
        """The observation of each reachable state, as the environment gives it."""
        assert self.exact is not None
        space, found = self.env.observation_space, {}
        for state in np.flatnonzero(self.exact.model.reachable).tolist():
            seen = self.exact.observations[state]
            if isinstance(space, spaces.Discrete):
                seen = int(seen)
            elif isinstance(space, spaces.Tuple | spaces.Dict):
                seen = tuple(seen.tolist())
                seen = (
                    dict(zip(space, seen, strict=True)) if isinstance(space, spaces.Dict) else seen
                )
            found[state] = seen
        return found

    def played(self, act: Callable[[Any], int]) -> Evaluation:
        """The evaluation by episodes of a function from an observation to an action."""
        returns, lengths, successes = [], [], []
        for episode in range(N_EPISODES):
            obs, info = self.env.reset(seed=None if episode else SEED)
            rewards, done = [], False
            while not done:
                obs, reward, terminated, truncated, info = self.env.step(act(obs))
                rewards.append(float(reward))
                done = terminated or truncated
            returns.append(sum(rewards))
            lengths.append(len(rewards))
            successes += [bool(info["is_success"])] if "is_success" in info else []
        told = np.array(successes) if len(successes) == N_EPISODES else None
        yardstick = bracket_of(self.env) if self.exact is None else self.exact.yardstick
        return Evaluation(np.array(returns), np.array(lengths), told, None, yardstick)

    def map_of(self, actions: Ints, is_blank: Bools) -> str:
        """The map with the action of each state; "?" where ``is_blank``; empty without a map."""
        layout = None if self.exact is None else self.exact.layout
        if layout is None or self.exact is None:
            return ""
        cells = list("".join(layout.rows))
        for cell, letter in enumerate(cells):
            if letter in (FREE, START) and self.exact.model.reachable[cell]:
                sign = _ARROWS.get(layout.moves[actions[cell]], "*")
                cells[cell] = "?" if is_blank[cell] else sign
        width = layout.n_columns
        return "\n".join("".join(cells[at : at + width]) for at in range(0, len(cells), width))


def world_of(
    env: str | Env, env_kwargs: Mapping[str, Any], bins: Mapping[str, Any] | None = None
) -> World:
    """The world of an environment by its id and arguments, or of an object.

    ``bins`` are arguments of `envs.wrappers.DiscretizeObservation`. Episodes have a limit of 1000
    steps where the environment has none.

    Raises:
        UserError: if there is no such environment, or arguments do not fit.
    """
    if not isinstance(env, str) and env_kwargs:
        raise UserError("arguments of the environment go with its id, not with an object")
    made = make_env(env, env_kwargs) if isinstance(env, str) else env
    env_id = env if isinstance(env, str) else ""
    if time_limit(made) is None:
        made = gym.wrappers.TimeLimit(made, EVALUATION_TIME_LIMIT)
    for key in bins or ():
        if key not in BINS:
            raise unknown("--bins: unknown argument", key, BINS)
    try:
        made = DiscretizeObservation(made, **bins) if bins else made
    except MISTAKES as error:
        raise UserError(f"--bins: {one_line(error)}") from error
    told = ", ".join(f"{key} {value}" for key, value in env_kwargs.items())
    name = env_id or (type(made.unwrapped).__name__ if made.spec is None else made.spec.id)
    name = f"{name} ({told})" if told else name
    return World(name, made, evaluator_in(made), env_id, env_kwargs)
