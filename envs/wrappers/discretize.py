"""Vectors of numbers as one whole number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from envs.argument_checks import check_whole_number
from envs.wrappers.observation_encodings import row_major
from mdp.array_types import Floats, Ints


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
        env: gym.Env[Any, Any],
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
        counts = _per_dim("bins", bins, self.dims)
        self.bins = counts.astype(np.int64)
        if np.any(self.bins != counts) or np.any(self.bins < 1):
            raise ValueError(f"bins must be whole numbers from 1 on, not {bins}")
        self.low = _per_dim("low", space.low[self.dims] if low is None else low, self.dims)
        self.high = _per_dim("high", space.high[self.dims] if high is None else high, self.dims)
        self._check_bounds()
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

    def map_observations(self, batch: NDArray[Any]) -> Ints:
        """The indices of many vectors of shape (n, dimensions), shape (n,)."""
        places = (batch[:, self.dims].astype(np.float64) - self.low) / (self.high - self.low)
        places = np.clip(np.floor(places * self.bins), 0, self.bins - 1).astype(np.int64)
        return row_major(places, self.bins.tolist())

    def _check_bounds(self) -> None:
        for dim, low, high in zip(self.dims, self.low, self.high, strict=True):
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ValueError(
                    f"dimension {dim} of the observation has the bounds {low} and {high}: give "
                    f"finite low and high, or choose other dims"
                )
            if not low < high:
                raise ValueError(f"dimension {dim}: low {low} is not below high {high}")


def _chosen_dims(dims: Sequence[int] | None, n_dims: int) -> list[int]:
    if dims is None:
        return list(range(n_dims))
    try:
        chosen = [check_whole_number("dims", dim, 0, n_dims - 1) for dim in dims]
    except TypeError:
        chosen = []
    if not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(f"dims must list dimensions, each once, not {dims!r}")
    return chosen


def _per_dim(name: str, values: ArrayLike, dims: list[int]) -> Floats:
    """One value for each of the dimensions that count."""
    try:
        return np.broadcast_to(np.asarray(values, np.float64), (len(dims),)).copy()
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be one number, or one for each of the dimensions {dims}, not {values!r}"
        ) from None
