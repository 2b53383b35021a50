"""The environment on which something is rated: its scale, its tables, and its episodes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import RecordEpisodeStatistics

from rl_yardstick.envs.finite_spaces import Bijection, bijection_of, describe
from rl_yardstick.envs.known_models import time_limit
from rl_yardstick.envs.layout import FREE, START
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.mdp.transition_model import Bools, Ints
from rl_yardstick.pipeline.environments import EVALUATION_TIME_LIMIT, MISTAKES, make_env
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator, evaluator_in
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, bracket_of

N_EPISODES, SEED = 100, 0  # of a sampled rating
# Numbers in a text, but not the digits of a name such as int64.
_NUMBERS = re.compile(r"(?<![\w.])-?\d+(?:\.\d*)?(?:e[-+]\d+)?(?![\w.])|True|False")
_ARROWS = {(-1, 0): "^", (1, 0): "v", (0, -1): "<", (0, 1): ">"}

Env = gym.Env[Any, Any]


def key_of(key: Any) -> tuple[int, ...]:
    """The numbers in a state, or a state and an action; none if they are not whole."""
    text = str(list(key.values()) if isinstance(key, Mapping) else key)
    truth = {"True": 1.0, "False": 0.0}
    found = [truth[one] if one in truth else float(one) for one in _NUMBERS.findall(text)]
    return tuple(map(int, found)) if all(map(float.is_integer, found)) else ()


def by(shape: tuple[int, ...]) -> str:
    """A shape in words."""
    return " x ".join(map(str, shape)) or "one number"


@dataclass(frozen=True, eq=False)
class World:
    """An environment, with its exact evaluator if its model is known."""

    name: str  #: its id, with the arguments that were given
    env: Env
    exact: ExactEvaluator | None

    @cached_property
    def numbering(self) -> Bijection:
        """The numbers of the observations, which are the rows of tables.

        Raises:
            UserError: if observations or actions are not finitely many.
        """
        observed, actions = self.env.observation_space, self.env.action_space
        if isinstance(self.env, DiscretizeObservation):
            observed = spaces.MultiDiscrete(self.env.bins)
        found = bijection_of(observed, ())
        if found is None or not isinstance(actions, spaces.Discrete):
            told = f"observations {describe(observed)} and actions {describe(actions)}"
            given = "give the bins of the table, as in --bins bins:10 low:[-2,-3] high:[2,3]"
            raise UserError(f"{self.name} has {told}, for which there is no table: {given}")
        return found

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """How many values each part of an observation has."""
        ends = (self.numbering.member(row) for row in (0, self.shape[0] - 1))
        first, last = (np.array(key_of(end)) for end in ends)
        return tuple((last - first + 1).tolist())

    @property
    def shape(self) -> tuple[int, int]:
        """The number of states and of actions of its tables."""
        actions: Any = self.env.action_space
        return int(self.numbering.numbers_space.n), int(actions.n)

    def needs(self) -> str:
        """The shape of its tables, in words."""
        folded = "" if len(self.sizes) == 1 else f" or {by((*self.sizes, self.shape[1]))}"
        return f"{self.name} needs {by(self.shape)}{folded} (states x actions)"

    def rows(self, states: Any) -> Ints:
        """The rows of states in tables; ValueError if there is no such state.

        They are given as observations, shape (n, parts), or as rows, shape (n, 1).
        """
        is_whole = states.shape[1] == len(self.sizes)
        numbering = self.numbering if is_whole else Bijection(self.numbering.numbers_space)
        return numbering.numbers(states)

    def row_of(self, observation: Any) -> int:
        """The row of one observation."""
        is_number = isinstance(self.env, DiscretizeObservation)
        return int(observation) if is_number else self.numbering.number(observation)

    def observed(self) -> dict[int, Any]:
        """The observation of each reachable state, as the environment gives it."""
        assert self.exact is not None
        reachable = np.flatnonzero(self.exact.model.reachable)
        seen: Any = self.exact.observations[reachable]
        if numbering := bijection_of(self.env.observation_space, ()):
            seen = map(numbering.member, numbering.numbers(seen))
        return dict(zip(reachable.tolist(), seen, strict=True))

    def played(self, act: Callable[[Any], Any]) -> Evaluation:
        """The evaluation by episodes of a function from an observation to an action."""
        env = RecordEpisodeStatistics(self.env, N_EPISODES, "rated")
        successes = []
        for episode in range(N_EPISODES):
            obs, info = env.reset(seed=None if episode else SEED)
            is_over = False
            while not is_over:
                obs, _, terminated, truncated, info = env.step(act(obs))
                is_over = terminated or truncated
            successes.append(info.get("is_success"))
        told = None if None in successes else np.array(successes, np.bool_)
        scale = bracket_of(self.env) if self.exact is None else self.exact.yardstick
        return Evaluation(np.array(env.return_queue), np.array(env.length_queue), told, None, scale)

    def map_of(self, actions: Ints, is_blank: Bools) -> str:
        """The map with the action of each state; "?" where ``is_blank``; empty without a map."""
        if self.exact is None or (layout := self.exact.layout) is None:
            return ""
        cells = list("".join(layout.rows))
        for cell, letter in enumerate(cells):
            if letter in (FREE, START) and self.exact.model.reachable[cell]:
                sign = _ARROWS.get(layout.moves[actions[cell]], "*")
                cells[cell] = "?" if is_blank[cell] else sign
        return "\n".join(map("".join, np.reshape(cells, (-1, layout.n_columns))))


def world_of(
    env: str | Env | None, env_kwargs: Mapping[str, Any], bins: Mapping[str, Any] | None = None
) -> World:
    """The world of an environment by its id and arguments, or of an object.

    ``bins`` are arguments of `envs.wrappers.DiscretizeObservation`. Episodes have a limit of 1000
    steps where the environment has none.

    Raises:
        UserError: if there is no such environment, or arguments do not fit.
    """
    if env is None:
        raise UserError("no environment is named: give one, as in --env FrozenLake-v1")
    if not isinstance(env, str) and env_kwargs:
        raise UserError("arguments of the environment go with its id, not with an object")
    made = make_env(env, env_kwargs) if isinstance(env, str) else env
    if time_limit(made) is None:
        made = gym.wrappers.TimeLimit(made, EVALUATION_TIME_LIMIT)
    try:
        made = DiscretizeObservation(made, **bins) if bins else made
    except MISTAKES as error:
        raise UserError(f"--bins: {one_line(error)}") from error
    told = ", ".join(f"{key} {value}" for key, value in env_kwargs.items())
    name = type(made.unwrapped).__name__ if made.spec is None else made.spec.id
    return World(f"{name} ({told})" if told else name, made, evaluator_in(made))
