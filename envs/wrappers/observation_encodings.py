"""Whole numbers as one, and as one-hot vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from mdp.array_types import AnyInts, Ints


class FlattenToDiscrete(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns an observation of several whole numbers into one, the last number counting fastest.

    Args:
        env: an environment whose observations are MultiDiscrete, a Tuple of Discrete, or a
            Discrete, which is counted from zero afterwards.

    Raises:
        ValueError: if the observations are none of these, or too many for a 64-bit number.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        self._sizes, self._first = _sizes_and_starts(env.observation_space)
        n = math.prod(self._sizes)
        if n > np.iinfo(np.int64).max:
            raise ValueError(f"{env.observation_space} has {n} values, too many to be numbered")
        self.observation_space = spaces.Discrete(n)

    def observation(self, observation: Any) -> int:
        """The number of one observation."""
        if isinstance(observation, np.ndarray):
            observation = observation.ravel().tolist()
        index = 0
        values = observation if isinstance(observation, Sequence) else [observation]
        for value, size, first in zip(values, self._sizes, self._first, strict=True):
            index = index * size + int(value) - first
        return index

    def map_observations(self, batch: ArrayLike) -> Ints:
        """The numbers of many observations, shape (n,).

        Args:
            batch: whole numbers, the first axis counting the observations; for a Tuple, its parts
                side by side in shape (n, parts).
        """
        parts = np.asarray(batch, np.int64)
        return row_major(parts.reshape(len(parts), -1) - self._first, self._sizes)


class OneHotObservation(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns a number into a vector that is 1 at its place and 0 elsewhere.

    Args:
        env: an environment whose observations are Discrete.

    Raises:
        ValueError: if they are not.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Discrete):
            raise ValueError(f"OneHotObservation needs Discrete observations, not {space}")
        self._first = int(space.start)
        self._n = int(space.n)
        self.observation_space = spaces.Box(0, 1, (self._n,), np.float32)

    def observation(self, observation: int) -> NDArray[np.float32]:
        """The vector of one number."""
        hot = np.zeros(self._n, np.float32)
        hot[int(observation) - self._first] = 1
        return hot

    def map_observations(self, batch: AnyInts) -> NDArray[np.float32]:
        """The vectors of many numbers of shape (n,), shape (n, number of values)."""
        hot = np.zeros((len(batch), self._n), np.float32)
        hot[np.arange(len(batch)), np.asarray(batch) - self._first] = 1
        return hot


def row_major(parts: NDArray[Any], sizes: Sequence[int]) -> Ints:
    """The index of each row of ``parts``, the last column counting fastest."""
    index = np.zeros(len(parts), np.int64)
    for column, size in enumerate(sizes):
        index = index * size + parts[:, column]
    return index


def _sizes_and_starts(space: spaces.Space[Any]) -> tuple[list[int], list[int]]:
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel().tolist(), space.start.ravel().tolist()
    parts = space.spaces if isinstance(space, spaces.Tuple) else [space]
    discrete = [part for part in parts if isinstance(part, spaces.Discrete)]
    if not discrete or len(discrete) < len(parts):
        raise ValueError(
            f"FlattenToDiscrete needs MultiDiscrete, a Tuple of Discrete, or Discrete, not {space}"
        )
    return [int(part.n) for part in discrete], [int(part.start) for part in discrete]
