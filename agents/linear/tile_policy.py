"""The policy of agents on active tiles: their weights, in buffers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule

from agents.common.table_policy import TablePolicy
from agents.linear.tile_coding import tiles_of_all
from agents.linear.tile_settings import make_tiles, vectors_of
from mdp.array_types import Floats


class TilePolicy(TablePolicy):
    """Takes the action of the highest sum of weights over the active tiles.

    Args:
        observation_space: `Box` of shape (d,), or `Discrete`, each number of which is a tile.
        action_space: `Discrete` with A values.
        lr_schedule: not used; here because every policy is handed one.
        tiling: further arguments of `agents.linear.tile_settings.make_tiles`.
        values_states: whether there are weights of state values too.

    Attributes:
        weights: of action values or preferences, float64 of shape (tiles, A).
        state_weights: of state values, float64 of shape (tiles,), or (0,) without them.
        tiles: how observations become tiles.
    """

    weights: th.Tensor
    state_weights: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        tiling: dict[str, Any] | None = None,
        values_states: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, **kwargs)
        self.tiling = dict(tiling or {})
        n_actions = int(action_space.n)
        self.tiles = make_tiles(observation_space, **self.tiling, n_actions=n_actions)
        n_tiles = self.tiles.n_tiles
        self.register_buffer("weights", th.zeros((n_tiles, n_actions), dtype=th.float64))
        n_valued = n_tiles if values_states else 0
        self.register_buffer("state_weights", th.zeros(n_valued, dtype=th.float64))

    def _sizes(self) -> dict[str, Any]:
        return {"tiling": self.tiling, "values_states": len(self.state_weights) > 0}

    def sums(self, observations: NDArray[Any]) -> Floats:
        """Action values or preferences at n observations, shape (n, A)."""
        active = tiles_of_all(self.tiles, vectors_of(self.observation_space, observations))
        weights = self.weights.numpy()
        sums = np.zeros((len(active), weights.shape[1]))
        for tiles in active.T:  # in the order in which the training loops add up
            sums += weights[tiles]
        return sums

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best actions; an observation of each to shape (n,)."""
        assert isinstance(observation, th.Tensor)
        return th.from_numpy(self.sums(observation.numpy()).argmax(axis=1))
