"""Policies that keep what the environment allows at each observation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from agents.common.table_policy import TablePolicy
from mdp.array_types import Bools


class MaskBufferPolicy(TablePolicy):
    """A policy that may hold a mask for each observation, in its model file too.

    Attributes:
        allowed_actions: what the environment allows at each observation, bool of shape (S, A), a
            row of False where that is not known; only there after `keep_masks`.
    """

    allowed_actions: th.Tensor

    def keep_masks(self) -> None:
        """Make room for what the environment allows, where both spaces are `Discrete`."""
        sizes: Any = (self.observation_space, self.action_space)
        shape = tuple(int(space.n) for space in sizes)
        self.register_buffer("allowed_actions", th.zeros(shape, dtype=th.bool))

    @property
    def masks(self) -> Bools:
        """`allowed_actions` as an array that shares its memory, of no rows where there are none."""
        if "allowed_actions" not in self._buffers:
            n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
            return np.zeros((0, n_actions), dtype=np.bool_)
        return np.asarray(self.allowed_actions.numpy())

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Take over tables; an agent may go by masks that was saved without them, or no longer."""
        tables = {name: state_dict[name] for name in state_dict if name != "allowed_actions"}
        if "allowed_actions" in self._buffers:
            unknown = th.zeros_like(self.allowed_actions)
            tables["allowed_actions"] = state_dict.get("allowed_actions", unknown)
        return super().load_state_dict(tables, strict, assign)
