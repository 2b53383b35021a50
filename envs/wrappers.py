"""Wrappers that fit an environment to an agent: discrete or one-hot observations, other rewards.

The observation wrappers also map whole batches of observations (`map_observations`), which exact
evaluation needs: it asks a policy for every state at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from envs.arguments import check_flag, check_number
from envs.grid import GridWorld

Env = gym.Env[Any, Any]
Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class DiscretizeObservation(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns a vector into one number by cutting each of its dimensions into bins of equal width.

    The bin of a value is ``floor((value - low) / (high - low) * bins)``, computed in float64 and
    clipped to the first and the last bin. The observation is the index of the box that the vector
    lies in, the last dimension counting fastest.

    Args:
        env: an environment whose observations are a Box of one axis.
        bins: number of bins, one for all dimensions or one for each that counts.
        low: where the first bin begins, likewise; by default the bounds of the space.
        high: where the last bin ends, likewise.
        dims: indices of the dimensions that count; by default all.

    Raises:
        ValueError: if the observations are not such a Box, a dimension does not exist, the numbers
            of arguments disagree, there are no bins, or bounds are infinite or out of order.
    """

    def __init__(
        self,
        env: Env,
        bins: int | Sequence[int],
        low: float | Sequence[float] | None = None,
        high: float | Sequence[float] | None = None,
        dims: Sequence[int] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, bins=bins, low=low, high=high, dims=dims)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"DiscretizeObservation needs a Box of one axis, not {space}")
        self.dims = _chosen_dims(dims, space.shape[0])
        self.bins = _per_dim("bins", bins, self.dims).astype(np.int64)
        self.low = _per_dim("low", space.low[self.dims] if low is None else low, self.dims)
        self.high = _per_dim("high", space.high[self.dims] if high is None else high, self.dims)
        self._check()
        self.observation_space = spaces.Discrete(math.prod(self.bins.tolist()))
        self._cuts = list(
            zip(self.dims, *(a.tolist() for a in (self.low, self.high, self.bins)), strict=True)
        )

    def observation(self, observation: NDArray[Any]) -> int:
        """The index of the box that one vector lies in."""
        index = 0
        for dim, low, high, bins in self._cuts:
            place = (float(observation[dim]) - low) / (high - low) * bins
            index = index * bins + int(min(max(place, 0), bins - 1))
        return index

    def map_observations(self, batch: NDArray[Any]) -> NDArray[np.int64]:
        """The indices of many vectors of shape (n, dimensions), shape (n,)."""
        places = (batch[:, self.dims].astype(np.float64) - self.low) / (self.high - self.low)
        places = np.clip(np.floor(places * self.bins), 0, self.bins - 1).astype(np.int64)
        return _row_major(places, self.bins.tolist())

    def _check(self) -> None:
        for dim, low, high, bins in zip(self.dims, self.low, self.high, self.bins, strict=True):
            if bins < 1:
                raise ValueError(f"bins: dimension {dim} has {bins} bins, it needs at least one")
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ValueError(
                    f"dimension {dim} of the observation has the bounds {low} and {high}: give "
                    f"finite low and high, or choose other dims"
                )
            if not low < high:
                raise ValueError(f"dimension {dim}: low {low} is not below high {high}")


class FlattenToDiscrete(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns an observation of several whole numbers into one, the last number counting fastest.

    Args:
        env: an environment whose observations are MultiDiscrete, a Tuple of Discrete, or a
            Discrete, which is counted from zero afterwards.

    Raises:
        ValueError: if the observations are none of these, or too many for a 64-bit number.
    """

    def __init__(self, env: Env) -> None:
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

    def map_observations(self, batch: ArrayLike) -> NDArray[np.int64]:
        """The numbers of many observations, shape (n,).

        Args:
            batch: whole numbers, the first axis counting the observations; for a Tuple, its parts
                side by side in shape (n, parts).
        """
        parts = np.asarray(batch, np.int64)
        return _row_major(parts.reshape(len(parts), -1) - self._first, self._sizes)


class OneHotObservation(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns a number into a vector that is 1 at its place and 0 elsewhere.

    Args:
        env: an environment whose observations are Discrete.

    Raises:
        ValueError: if they are not.
    """

    def __init__(self, env: Env) -> None:
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

    def map_observations(self, batch: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """The vectors of many numbers of shape (n,), shape (n, number of values)."""
        hot = np.zeros((len(batch), self._n), np.float32)
        hot[np.arange(len(batch)), np.asarray(batch) - self._first] = 1
        return hot


class ScaleReward(gym.RewardWrapper[Any, Any], RecordConstructorArgs):
    """Multiplies every reward.

    Args:
        env: any environment.
        scale: the factor.

    Raises:
        ValueError: if the factor is zero or not a finite number.
    """

    def __init__(self, env: Env, scale: float) -> None:
        RecordConstructorArgs.__init__(self, scale=scale)
        gym.RewardWrapper.__init__(self, env)
        self.scale = check_number("scale", scale)
        if self.scale == 0:
            raise ValueError("scale must not be 0: every reward would be the same")

    def reward(self, reward: SupportsFloat) -> float:
        """The scaled reward."""
        return float(reward) * self.scale


class TerminationReward(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Puts a reward in place of the last one of an episode.

    Args:
        env: any environment. What lies outside this wrapper, such as a further time limit, it does
            not see.
        reward: the reward of the step that terminates the episode.
        on_truncation: give it also where time runs out.

    Raises:
        ValueError: if the reward is not a finite number.
    """

    def __init__(self, env: Env, reward: float, on_truncation: bool = False) -> None:
        RecordConstructorArgs.__init__(self, reward=reward, on_truncation=on_truncation)
        gym.Wrapper.__init__(self, env)
        self.last_reward = check_number("reward", reward)
        self.on_truncation = check_flag("on_truncation", on_truncation)

    def step(self, action: Any) -> Step:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated or (truncated and self.on_truncation):
            reward = self.last_reward
        return obs, reward, terminated, truncated, info


def limit_by_shortest_path(env: Env, multiple: int, instead_of: int) -> Env:
    """Limit the episodes of a grid world to a multiple of its shortest path.

    Args:
        env: a grid world as `gymnasium.make` returns it.
        multiple: the limit in shortest paths.
        instead_of: the limit that this one takes the place of. One that differs, or none, is the
            wish of whoever made the environment, and stays.

    Returns:
        The environment under the limit.
    """
    grid_world = env.unwrapped
    if not isinstance(env, gym.wrappers.TimeLimit) or env.spec is None:
        return env
    if env.spec.max_episode_steps != instead_of or not isinstance(grid_world, GridWorld):
        return env
    return gym.wrappers.TimeLimit(env.env, multiple * grid_world.shortest_path_length)


def _chosen_dims(dims: Sequence[int] | None, n_dims: int) -> list[int]:
    chosen = list(range(n_dims)) if dims is None else list(dims)
    wrong = [dim for dim in chosen if dim not in range(n_dims)]
    if wrong or not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"dims must name each dimension once, from 0 to {n_dims - 1}, not {chosen}"
        )
    return chosen


def _per_dim(name: str, values: ArrayLike, dims: list[int]) -> NDArray[np.float64]:
    """One value for each of the dimensions that count."""
    given = np.asarray(values, np.float64)
    if given.shape not in {(), (len(dims),)}:
        raise ValueError(
            f"{name} must be one number or {len(dims)}, one for each of the dimensions {dims}"
        )
    return np.broadcast_to(given, len(dims)).copy()


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


def _row_major(parts: NDArray[Any], sizes: Sequence[int]) -> NDArray[np.int64]:
    """The index of each row of ``parts``, the last column counting fastest."""
    index = np.zeros(len(parts), np.int64)
    for column, size in enumerate(sizes):
        index = index * size + parts[:, column]
    return index
