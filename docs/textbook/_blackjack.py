"""Blackjack as the book plays it, which two figures have in common."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envs.known_models import transition_model
from envs.wrappers import FlattenToDiscrete
from mdp.array_types import Floats, Ints
from mdp.transition_model import TransitionModel

STICK, HIT = 0, 1
STICKS_FROM = 20
PLAYER, DEALER = np.arange(12, 22), np.arange(1, 11)  # below 12 to hit cannot hurt


def game() -> gym.Env[Any, Any]:
    """Gymnasium's game by the book's rules, its observations numbered."""
    return FlattenToDiscrete(gym.make("Blackjack-v1", sab=True))


def model() -> TransitionModel:
    """Its exact dynamics, one state for each observation and eleven for naturals."""
    known = transition_model(game())
    assert known is not None
    return known


def observations() -> Ints:
    """Numbers of the observations that the figures show: usable ace (no, yes), player, dealer."""
    ace, player, dealer = np.ix_(np.arange(2), PLAYER, DEALER)
    return np.asarray((player * 11 + dealer) * 2 + ace)


def stick_on_twenty(n_observations: int) -> Ints:
    """The policy of example 5.1, an action for each observation."""
    return np.where(np.arange(n_observations) // 22 >= STICKS_FROM, STICK, HIT)


class OnePolicy(gym.Wrapper[Any, Any, Any, Any]):
    """Plays a policy: its one action is what that does, so that a learner only predicts."""

    def __init__(self, env: gym.Env[Any, Any], policy: Ints) -> None:
        super().__init__(env)
        self.policy = policy
        self.action_space = spaces.Discrete(1)
        self._obs = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._obs, info = self.env.reset(**kwargs)
        return self._obs, info

    def step(self, action: int) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step of the policy."""
        result = self.env.step(self.policy[self._obs])
        self._obs = result[0]
        return result


def surfaces(axes: Any, values: Floats, title: str) -> None:
    """Draw a value for each sum of the player and card of the dealer, shape (10, 10)."""
    mesh = axes.imshow(
        values, origin="lower", extent=(0.5, 10.5, 11.5, 21.5), vmin=-1, vmax=1, cmap="coolwarm"
    )
    axes.set(title=title, xlabel="dealer shows", ylabel="player's sum")
    axes.figure.colorbar(mesh, ax=axes, shrink=0.7)
