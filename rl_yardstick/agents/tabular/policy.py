"""The policy of the tabular agents: action values in tables, and action masks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th

from rl_yardstick.agents.common.masks import MaskBufferPolicy, numbers_in
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints


class QTablePolicy(MaskBufferPolicy):
    """Greedy in the mean of one or two tables of action values.

    The tables are float64 buffers, so that a model file's ``policy.pth`` contains them, and they
    need neither optimizer nor gradient.
    """

    q_tables: th.Tensor  # action values, float64 of shape (T, S, A)
    visit_counts: th.Tensor  # number of updates of each entry, int64 of shape (T, S, A)

    def __init__(self, *args: Any, n_tables: int = 1, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        sizes: Any = self.observation_space, self.action_space
        shape = (n_tables, *(int(space.n) for space in sizes))
        self.register_buffer("q_tables", th.zeros(shape, dtype=th.float64))
        self.register_buffer("visit_counts", th.zeros(shape, dtype=th.int64))

    def _sizes(self) -> dict[str, Any]:
        return {"n_tables": len(self.q_tables)}

    @property
    def q_table(self) -> Floats:
        """The action values that the agent acts on, shape (S, A)."""
        return np.asarray(self.q_tables.numpy().mean(axis=0))

    def note_masks(self, obs: Any, masks: Bools) -> None:
        """Store the masks, shape (n, A), of observations of shape (n,); ValueError if changed."""
        allowed, obs = self.masks, np.asarray(obs)
        before = allowed[obs]
        changed = before.any(axis=1) & (before != masks).any(axis=1)
        allowed[obs] = masks
        if changed.any() or not np.array_equal(allowed[obs], masks):
            odd = obs[np.flatnonzero(changed | (allowed[obs] != masks).any(axis=1))[0]]
            raise ValueError(
                f"observation {odd} comes with different action masks: mask_actions needs masks "
                "that depend on the observation alone"
            )

    @contextmanager
    def told(self, obs: Ints, masks: Any) -> Iterator[None]:
        """Use other masks at these observations within a ``with`` statement; no change if None."""
        if masks is None or not len(self.masks):
            yield
            return
        kept = self.masks[obs]
        self.masks[obs] = masks
        try:
            yield
        finally:
            self.masks[obs] = kept

    def allowed_values(self, obs: Ints) -> Floats:
        """Action values at n observations, minus infinity where masked, shape (n, A)."""
        values: Floats = self.q_tables.numpy()[:, obs].mean(axis=0)
        if not len(self.masks):
            return values
        masks = self.masks[obs]
        return np.where(masks | ~masks.any(axis=1, keepdims=True), values, -np.inf)

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best allowed actions for each observation, shape (n,)."""
        obs = numbers_in(self.observation_space, observation).reshape(-1)
        return th.from_numpy(self.allowed_values(obs).argmax(axis=1))
