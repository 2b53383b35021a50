"""Observations of `Discrete` spaces, as tables are looked up by them."""

from __future__ import annotations

from typing import Any

import numpy as np

from mdp.array_types import Ints


def numbers_in(space: Any, observations: Any) -> Ints:
    """Observations as whole numbers, in their own shape.

    Args:
        space: `Discrete`, beginning at 0.
        observations: of any shape.

    Raises:
        ValueError: if one is not in the space, which would be looked up in the row of another.
    """
    given = np.asarray(observations)
    outside = given[~((given >= 0) & (given < space.n) & (given == np.floor(given)))]
    if outside.size:
        raise ValueError(f"observation {outside[0]} is not in {space}, the agent's space")
    return given.astype(np.int64)
