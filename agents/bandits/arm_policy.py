"""What the policies of bandit agents share: they pull the arm that they judge best."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from agents.common.mask_buffers import MaskBufferPolicy
from mdp.array_types import Bools, Floats, Ints


class ArmPolicy(MaskBufferPolicy):
    """Pulls the first of the arms judged best, of those that were allowed where masks are kept."""

    @abstractmethod
    def judged(self, observations: NDArray[Any]) -> Floats:
        """What each arm is judged by at each of n observations, shape (n, arms)."""

    def kept_masks(self, observations: Ints) -> Bools:
        """What was allowed last at observations of shape (n,), everything where none was met.

        Returns:
            Masks, bool of shape (n, arms).

        Raises:
            ValueError: if an observation has no row.
        """
        outside = observations[(observations < 0) | (observations >= len(self.masks))]
        if outside.size:
            raise ValueError(f"context {outside[0]} is not in Discrete({len(self.masks)})")
        masks = self.masks[observations]
        return np.asarray(masks | ~masks.any(axis=1, keepdims=True))

    def best_arms(self, observations: NDArray[Any], masks: Bools) -> Ints:
        """The first of the best arms of those in ``masks``, of shape (n, arms)."""
        judged = self.judged(observations)
        # Among the allowed alone: an arm may be judged to be worth minus infinity.
        allowed = [np.flatnonzero(mask) for mask in masks]
        best = [arms[row[arms].argmax()] for arms, row in zip(allowed, judged, strict=True)]
        return np.array(best, dtype=np.int64)

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best arms; an observation of each to shape (n,)."""
        assert isinstance(observation, th.Tensor)
        observations = observation.numpy()
        if len(self.masks):
            rows = observations.astype(np.int64).reshape(-1)
            return th.from_numpy(self.best_arms(rows, self.kept_masks(rows)))
        return th.from_numpy(self.judged(observations).argmax(axis=1))
