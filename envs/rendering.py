"""Pictures and text of grid worlds; the only module that draws with pygame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Scene:
    """What changes from one picture of a grid world to the next."""

    robot: int
    path: Sequence[int]
    collected: Sequence[int]
    last_action: int | None


class GridRenderer:
    """Draws one map; keeps what stays the same between pictures."""

    def __init__(self, rows: Sequence[str], fps: int) -> None:
        self.rows = rows
        self.fps = fps

    def render(self, scene: Scene, mode: str) -> str | NDArray[np.uint8] | None:
        """Draw a scene."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the window."""
