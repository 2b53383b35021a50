"""How the things of a grid world look: colours, and shapes in a unit square, y pointing down.

The colours are those of Okabe and Ito ("Color universal design", 2008) where things must be told
apart, and every thing has a shape of its own, so that no meaning rests on colour alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

Colour = tuple[int, int, int]
Point = tuple[float, float]

FLOOR: Colour = (246, 244, 239)
GRID: Colour = (226, 222, 212)
SHELF: Colour = (84, 92, 107)
SHELF_LIGHT: Colour = (112, 121, 138)
SHELF_DARK: Colour = (62, 69, 82)
BLUE: Colour = (0, 114, 178)
DARK_BLUE: Colour = (0, 72, 120)
SKY: Colour = (176, 214, 238)
GREEN: Colour = (0, 142, 104)
PALE_GREEN: Colour = (205, 235, 224)
VERMILION: Colour = (213, 94, 0)
ORANGE: Colour = (240, 170, 20)
PALE_RED: Colour = (250, 226, 212)
PALE_YELLOW: Colour = (252, 243, 206)
INK: Colour = (38, 42, 50)
WHITE: Colour = (255, 255, 255)


class Disc(NamedTuple):
    """A filled circle."""

    centre: Point
    radius: float
    colour: Colour


class Ring(NamedTuple):
    """A circle's outline, its width inside the radius."""

    centre: Point
    radius: float
    width: float
    colour: Colour


class Box(NamedTuple):
    """A filled rectangle, its corners rounded."""

    corner: Point
    size: Point
    rounding: float
    colour: Colour


class Polygon(NamedTuple):
    """A filled polygon."""

    points: tuple[Point, ...]
    colour: Colour


class Label(NamedTuple):
    """A line of text."""

    text: str
    at: Point
    height: float
    colour: Colour
    # Which part of the text stands there: 0 its left end, 0.5 its middle, 1 its right end.
    align: float = 0.5


Shape = Disc | Ring | Box | Polygon | Label


def _star(n_rays: int, outer: float, inner: float) -> tuple[Point, ...]:
    radii = (outer, inner) * n_rays
    angles = (math.pi * i / n_rays for i in range(2 * n_rays))
    return tuple(
        (0.5 + radius * math.sin(angle), 0.5 - radius * math.cos(angle))
        for radius, angle in zip(radii, angles, strict=True)
    )


_WHOLE_CELL: tuple[Point, Point, float] = ((0, 0), (1, 1), 0)
_BOLT = ((0.58, 0.14), (0.24, 0.57), (0.46, 0.57), (0.40, 0.87), (0.76, 0.42), (0.53, 0.42))

SHELF_SHAPES: tuple[Shape, ...] = (
    Box((0.03, 0.03), (0.94, 0.94), 0.10, SHELF_DARK),
    Box((0.03, 0.03), (0.94, 0.86), 0.10, SHELF),
    Box((0.14, 0.15), (0.72, 0.20), 0.04, SHELF_LIGHT),
    Box((0.14, 0.47), (0.72, 0.20), 0.04, SHELF_LIGHT),
)
START_SHAPES: tuple[Shape, ...] = (
    Box(*_WHOLE_CELL, SKY),
    Ring((0.5, 0.5), 0.34, 0.07, BLUE),
)
GOAL_SHAPES: tuple[Shape, ...] = (
    Box(*_WHOLE_CELL, PALE_GREEN),
    Box((0.27, 0.14), (0.07, 0.74), 0.03, INK),
    Polygon(((0.34, 0.16), (0.82, 0.34), (0.34, 0.52)), GREEN),
    Box((0.17, 0.84), (0.27, 0.06), 0.03, INK),
)
MINE_SHAPES: tuple[Shape, ...] = (
    Box(*_WHOLE_CELL, PALE_RED),
    Polygon(_star(8, 0.42, 0.26), INK),
    Disc((0.5, 0.5), 0.30, INK),
    Disc((0.5, 0.5), 0.13, VERMILION),
)
POWER_SHAPES: tuple[Shape, ...] = (
    Box(*_WHOLE_CELL, PALE_YELLOW),
    Disc((0.5, 0.5), 0.42, ORANGE),
    Polygon(_BOLT, WHITE),
)
EMPTIED_SHAPES: tuple[Shape, ...] = (
    Box(*_WHOLE_CELL, FLOOR),
    Ring((0.5, 0.5), 0.42, 0.04, GRID),
)
BURST_SHAPES: tuple[Shape, ...] = (
    Polygon(_star(9, 0.50, 0.34), VERMILION),
    Polygon(_star(9, 0.42, 0.28), ORANGE),
)
# Seen from above, driving up.
ROBOT_SHAPES: tuple[Shape, ...] = (
    Box((0.08, 0.17), (0.20, 0.27), 0.06, INK),
    Box((0.72, 0.17), (0.20, 0.27), 0.06, INK),
    Box((0.08, 0.57), (0.20, 0.27), 0.06, INK),
    Box((0.72, 0.57), (0.20, 0.27), 0.06, INK),
    Box((0.17, 0.09), (0.66, 0.82), 0.17, DARK_BLUE),
    Box((0.20, 0.12), (0.60, 0.76), 0.15, BLUE),
    Box((0.25, 0.19), (0.50, 0.26), 0.12, WHITE),
    Disc((0.38, 0.32), 0.065, INK),
    Disc((0.62, 0.32), 0.065, INK),
    Ring((0.5, 0.66), 0.12, 0.05, SKY),
)

LETTER_SHAPES: dict[str, tuple[Shape, ...]] = {
    "#": SHELF_SHAPES,
    "S": START_SHAPES,
    "G": GOAL_SHAPES,
    "M": MINE_SHAPES,
    "P": POWER_SHAPES,
}
# One colour each, for maps whose cells are too small to show a shape.
LETTER_COLOURS: dict[str, Colour] = {
    "#": SHELF_LIGHT,
    ".": FLOOR,
    "S": SKY,
    "G": GREEN,
    "M": VERMILION,
    "P": ORANGE,
}
TRAIL_WIDTH = 0.16


def trail_shapes(sides: frozenset[int]) -> tuple[Shape, ...]:
    """A line from the middle of a cell to some of its sides: 0 up, 1 down, 2 left, 3 right."""
    half = TRAIL_WIDTH / 2
    arms = {
        0: Box((0.5 - half, 0), (TRAIL_WIDTH, 0.5), 0, BLUE),
        1: Box((0.5 - half, 0.5), (TRAIL_WIDTH, 0.5), 0, BLUE),
        2: Box((0, 0.5 - half), (0.5, TRAIL_WIDTH), 0, BLUE),
        3: Box((0.5, 0.5 - half), (0.5, TRAIL_WIDTH), 0, BLUE),
    }
    return (Disc((0.5, 0.5), half, BLUE), *(arms[side] for side in sorted(sides)))
