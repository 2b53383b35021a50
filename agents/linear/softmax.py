"""Policies that draw actions by a softmax of preferences, and steps along their gradient.

With binary features, the gradient of ln pi(a) by the weights of action b at an active tile is
1 - pi(b) for b = a, and -pi(b) else.

Source: Sutton and Barto (2nd edition), sections 13.1 and 13.3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.common.exploration import BOLTZMANN, action_probabilities, highest_value
from agents.common.setting_checks import check_finite
from agents.compiled.generators import next_uniform
from agents.linear.tile_algorithm import TileAlgorithm, TileArguments
from agents.linear.weighted_tiles import LinearAgent, add_up, move_sum
from machine_code.compiling import called
from mdp.array_types import Floats, Ints


@called
def make_probabilities(sums: Floats) -> None:
    """Turn preferences into the probabilities of their softmax, shape (A,)."""
    highest, total = highest_value(sums), 0.0
    for action in range(len(sums)):
        sums[action] = math.exp(sums[action] - highest)
        total += sums[action]
    for action in range(len(sums)):
        sums[action] /= total


@called
def draw_by_preference(agent: LinearAgent, progress: Any) -> int:
    """An action with probability proportional to exp(preference)."""
    probabilities, remaining = agent.room.sums, next_uniform(agent.rng)
    make_probabilities(probabilities)
    for action in range(len(probabilities) - 1):
        remaining -= probabilities[action]
        if remaining < 0.0:
            return action
    return len(probabilities) - 1


@called
def ascend(agent: LinearAgent, tiles: Ints, action: int, step: float) -> None:
    """Move the preferences at these tiles by a step along the gradient of ln pi(action)."""
    probabilities = agent.room.sums
    add_up(agent, tiles)
    make_probabilities(probabilities)
    for other in range(len(probabilities)):
        chosen = 1.0 if other == action else 0.0
        move_sum(agent.weights, tiles, other, step * (chosen - probabilities[other]))


@called
def state_value(weights: Floats, tiles: Ints) -> float:
    """The sum of a state value's weights over the tiles."""
    total = 0.0
    for k in range(len(tiles)):
        total += weights[tiles[k]]
    return total


@called
def move_state_value(weights: Floats, tiles: Ints, step: float) -> None:
    """Move the sum of a state value's weights over the tiles by a step."""
    for k in range(len(tiles)):
        weights[tiles[k]] += step


class SoftmaxArguments(TileArguments, total=False):
    """What the constructors of these agents hand on; see `SoftmaxAlgorithm`."""

    initial_preferences: float | Sequence[float]
    gamma_power: bool


class SoftmaxAlgorithm(TileAlgorithm):
    """A policy gradient on preferences that are sums of weights over active tiles.

    Args:
        policy: ``"TilePolicy"``; greedy means the action that is most probable.
        env: as in `TileAlgorithm`.
        learning_rate: step size of the policy, as in `TileAlgorithm`.
        initial_preferences: each action's preference at the start, a number or a list of A.
        gamma_power: weigh what is learnt about the policy at step t of an episode by gamma to the
            power t, as the book's pseudocode does; many programs leave that out.
        kwargs: as in `TileAlgorithm`.
    """

    parameters = {"gamma_power": np.bool_}  # noqa: RUF012
    choose_by_sums = draw_by_preference

    def __init__(
        self,
        policy: str | type[BasePolicy] = "TilePolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        initial_preferences: float | Sequence[float] = 0.0,
        gamma_power: bool = True,
        **kwargs: Unpack[TileArguments],
    ) -> None:
        self.initial_preferences = initial_preferences
        self.gamma_power = gamma_power
        super().__init__(policy, env, learning_rate, **kwargs)

    def _initial_sums(self) -> Floats:
        given = np.asarray(self.initial_preferences, dtype=np.float64)
        if given.shape not in ((), (self.n_actions,)):
            raise ValueError(
                f"initial_preferences must be a number or {self.n_actions} numbers, "
                f"not {self.initial_preferences}"
            )
        check_finite([("initial_preferences", float(number)) for number in given.flat])
        return np.broadcast_to(given, self.n_actions)

    def _probabilities(self, sums: Floats) -> Floats:
        return action_probabilities(BOLTZMANN, sums, 1.0, random_ties=False)
