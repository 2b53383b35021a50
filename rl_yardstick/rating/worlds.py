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
from numpy.typing import NDArray

from rl_yardstick.envs.known_models import model_check, time_limit
from rl_yardstick.envs.layout import FREE, START, grid_layout
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.pipeline.environments import (
    EVALUATION_TIME_LIMIT,
    MISTAKES,
    evaluation_kwargs,
    make_env,
)
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator, evaluator_in
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, Yardstick, bracket_of
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.rating.tables import Rows, flat, rows_of

N_EPISODES, SEED = 100, 0  # of a sampled rating
_ARROWS = {(-1, 0): "^", (1, 0): "v", (0, -1): "<", (0, 1): ">"}

Env = gym.Env[Any, Any]


@dataclass(frozen=True, eq=False)
class World:
    """An environment with its exact evaluator, if its model is known."""

    name: str  #: its id, with the arguments that were given
    env: Env
    exact: ExactEvaluator | None
    env_id: str = ""  #: empty for an environment that was given as an object
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def rows(self) -> Rows:
        """The rows of its tables; UserError if it has none."""
        rows = rows_of(self.env, self.name)
        exact = self.exact
        seen = None
        if exact is not None:
            states = exact.observations[exact.model.reachable]
            seen = np.asarray(states, np.int64).reshape(len(states), -1)
            if seen.shape[1] != len(rows.sizes):  # of a wrapper that numbers them
                seen = None
        return Rows(
            self.name, rows.parts, rows.n_actions, rows.actions, seen, grid_layout(self.env)
        )

    @cached_property
    def row_of_state(self) -> NDArray[np.int64]:
        """The row of the observation of each state of the model, shape (S,)."""
        assert self.exact is not None
        found = self.exact.observations
        if isinstance(self.env, DiscretizeObservation):
            return np.asarray(found, np.int64)
        numbers = np.zeros(len(found), np.int64)
        reachable = self.exact.model.reachable
        parts = np.asarray(found, np.int64).reshape(len(found), -1)
        numbers[reachable] = self.rows.numbers(parts[reachable])
        return numbers

    def row_of(self, observation: Any) -> int:
        """The row of one observation."""
        if isinstance(self.env, DiscretizeObservation):
            return int(observation)
        return int(self.rows.numbers(np.array([flat(observation)]))[0])

    @property
    def yardstick(self) -> Yardstick | None:
        """The scale of returns, if it is known."""
        return bracket_of(self.env) if self.exact is None else self.exact.yardstick

    @property
    def why_sampled(self) -> str:
        """Why episodes are sampled."""
        check = model_check(self.env)
        refusal = None if check is None else check.refusal
        return refusal or f"no model of {self.name} is known"

    @cached_property
    def other(self) -> World | None:
        """The same lake, slippery if this one is not, and the other way round."""
        base = self.env.unwrapped
        if (
            not (self.env_id and isinstance(base, FrozenLakeEnv))
            or "is_slippery" in self.env_kwargs
        ):
            return None
        slips = any(len(outcomes) > 1 for outcomes in base.P[0].values())
        return world_of(self.env_id, {**self.env_kwargs, "is_slippery": not slips})

    def states_observed(self) -> dict[int, Any]:
        """The observation of each reachable state, as the environment gives it."""
        assert self.exact is not None
        states = np.flatnonzero(self.exact.model.reachable).tolist()
        space = self.env.observation_space
        return {state: _original(space, self.exact.observations[state]) for state in states}

    def played(self, act: Callable[[Any], Any], n_episodes: int = N_EPISODES) -> Evaluation:
        """The evaluation by episodes of a function from an observation to an action."""
        returns, lengths, successes = [], [], []
        for episode in range(n_episodes):
            obs, _ = self.env.reset(seed=SEED if episode == 0 else None)
            total, length, done = 0.0, 0, False
            while not done:
                obs, reward, terminated, truncated, info = self.env.step(act(obs))
                total, length, done = total + float(reward), length + 1, terminated or truncated
            returns.append(total)
            lengths.append(length)
            successes += [bool(info["is_success"])] if "is_success" in info else []
        told = np.array(successes) if len(successes) == n_episodes else None
        return Evaluation(np.array(returns), np.array(lengths), told, None, self.yardstick)

    def map_of(self, actions: NDArray[Any], is_blank: NDArray[Any]) -> tuple[str, ...]:
        """The map with the action of each state; "?" where ``is_blank``; empty without a map."""
        layout = None if self.exact is None else self.exact.layout
        if layout is None or self.exact is None:
            return ()
        cells = list("".join(layout.rows))
        for cell, letter in enumerate(cells):
            if letter in (FREE, START) and self.exact.model.reachable[cell]:
                sign = _ARROWS.get(layout.moves[actions[cell]], "*")
                cells[cell] = "?" if is_blank[cell] else sign
        width = layout.n_columns
        return tuple("".join(cells[at : at + width]) for at in range(0, len(cells), width))


def world_of(
    env: str | Env, env_kwargs: Mapping[str, Any], bins: Mapping[str, Any] | None = None
) -> World:
    """The world of an environment by its id and arguments, or of an object.

    ``bins`` are arguments of `envs.wrappers.DiscretizeObservation`. Episodes have a limit of 1000
    steps where the environment has none.

    Raises:
        UserError: if there is no such environment, or arguments do not fit.
    """
    if isinstance(env, str):
        spec = TrainSpec(algo="", env_id=env, env_kwargs=dict(env_kwargs))
        made, env_id = make_env(env, env_kwargs), env
        limit = evaluation_kwargs(spec).get("max_episode_steps")
    elif env_kwargs:
        raise UserError("arguments of the environment go with its id, not with an object")
    else:
        made, env_id, limit = env, "", EVALUATION_TIME_LIMIT
    if time_limit(made) is None:
        made = gym.wrappers.TimeLimit(made, limit or EVALUATION_TIME_LIMIT)
    if bins:
        try:
            made = DiscretizeObservation(made, **bins)
        except MISTAKES as error:
            raise UserError(f"--bins: {one_line(error)}") from error
    id_of_spec = made.spec.id if made.spec is not None else type(made.unwrapped).__name__
    told = ", ".join(f"{key} {value}" for key, value in env_kwargs.items())
    name = f"{env_id or id_of_spec} ({told})" if told else env_id or id_of_spec
    return World(name, made, evaluator_in(made), env_id, env_kwargs)


def _original(space: spaces.Space[Any], found: Any) -> Any:
    """One observation of a model, as its space has it."""
    if isinstance(space, spaces.Discrete):
        return int(found)
    if isinstance(space, spaces.Tuple):
        return tuple(int(part) for part in found)
    if isinstance(space, spaces.Dict):
        return dict(zip(space, (int(part) for part in found), strict=True))
    return found
