"""What pictures show."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from envs.sprites import Shape


@dataclass(frozen=True)
class Scene:
    """A moment of an episode in a grid world; cells are numbered row by row.

    Attributes:
        rows: the map.
        robot: where the robot is.
        steps: pairs of neighbouring cells that it has gone from and to, in no order.
        collected: cells that it has emptied.
        last_action: its latest move, 0 up, 1 down, 2 left, 3 right; None before the first.
        title: what to write above the map as text; None for the latest move.
    """

    rows: tuple[str, ...]
    robot: int
    steps: Collection[tuple[int, int]]
    collected: Collection[int]
    last_action: int | None
    title: str | None = None

    def place(self, cell: int) -> tuple[int, int]:
        """Row and column of a cell."""
        return divmod(cell, len(self.rows[0]))


@dataclass(frozen=True)
class Chart:
    """A picture made of shapes whose coordinates are pixels.

    Attributes:
        size: width and height in pixels.
        shapes: what it is made of, the hindmost first.
    """

    size: tuple[int, int]
    shapes: Sequence[Shape]
