"""Environments as pictures and in a window; the only module that draws with pygame."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.argument_checks import check_choice

if TYPE_CHECKING:
    import pygame

# The colours are those of Okabe and Ito ("Color universal design", 2008) where things must be told
# apart, and every thing has a shape of its own, so that no meaning rests on colour alone.
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
    """A circle, filled or as a ring of some width inside its radius."""

    centre: Point
    radius: float
    colour: Colour
    width: float = 0


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
    # The part of the text at this point: 0 its left end, 0.5 its middle, 1 its right end.
    align: float = 0.5


Shape = Disc | Box | Polygon | Label


def _star(n_rays: int, outer: float, inner: float) -> tuple[Point, ...]:
    radii = (outer, inner) * n_rays
    angles = (math.pi * i / n_rays for i in range(2 * n_rays))
    return tuple(
        (0.5 + radius * math.sin(angle), 0.5 - radius * math.cos(angle))
        for radius, angle in zip(radii, angles, strict=True)
    )


# Shapes in a unit square, y pointing down.
_WHOLE_CELL: tuple[Point, Point, float] = ((0, 0), (1, 1), 0)
_BOLT = ((0.58, 0.14), (0.24, 0.57), (0.46, 0.57), (0.40, 0.87), (0.76, 0.42), (0.53, 0.42))

LETTER_SHAPES: dict[str, tuple[Shape, ...]] = {
    "#": (
        Box((0.03, 0.03), (0.94, 0.94), 0.10, SHELF_DARK),
        Box((0.03, 0.03), (0.94, 0.86), 0.10, SHELF),
        Box((0.14, 0.15), (0.72, 0.20), 0.04, SHELF_LIGHT),
        Box((0.14, 0.47), (0.72, 0.20), 0.04, SHELF_LIGHT),
    ),
    "S": (Box(*_WHOLE_CELL, SKY), Disc((0.5, 0.5), 0.34, BLUE, 0.07)),
    "G": (
        Box(*_WHOLE_CELL, PALE_GREEN),
        Box((0.27, 0.14), (0.07, 0.74), 0.03, INK),
        Polygon(((0.34, 0.16), (0.82, 0.34), (0.34, 0.52)), GREEN),
        Box((0.17, 0.84), (0.27, 0.06), 0.03, INK),
    ),
    "M": (
        Box(*_WHOLE_CELL, PALE_RED),
        Polygon(_star(8, 0.42, 0.26), INK),
        Disc((0.5, 0.5), 0.30, INK),
        Disc((0.5, 0.5), 0.13, VERMILION),
    ),
    "P": (
        Box(*_WHOLE_CELL, PALE_YELLOW),
        Disc((0.5, 0.5), 0.42, ORANGE),
        Polygon(_BOLT, WHITE),
    ),
}
EMPTIED_SHAPES: tuple[Shape, ...] = (
    Box(*_WHOLE_CELL, FLOOR),
    Disc((0.5, 0.5), 0.42, GRID, 0.04),
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
    Disc((0.5, 0.66), 0.12, SKY, 0.05),
)

# One colour each, for maps whose cells are too small to show a shape.
LETTER_COLOURS: dict[str, Colour] = {
    "#": SHELF_LIGHT,
    ".": FLOOR,
    "S": SKY,
    "G": GREEN,
    "M": VERMILION,
    "P": ORANGE,
}


ROBOT, TRAIL = "R", "*"
# What a terminal of common size shows; of larger maps the part around the robot is drawn.
MAX_ROWS, MAX_COLUMNS = 40, 100


@dataclass(frozen=True)
class Scene:
    """A moment of an episode in a grid world; cells are numbered row by row."""

    rows: tuple[str, ...]
    robot: int
    steps: Collection[tuple[int, int]] = ()  # neighbouring cells that it has gone from and to
    collected: Collection[int] = ()  # cells that it has emptied
    last_move: int | None = None  # 0 up, 1 down, 2 left, 3 right; None before the first
    title: str = ""  # above the map as text

    def place(self, cell: int) -> tuple[int, int]:
        """Row and column of a cell."""
        return divmod(cell, len(self.rows[0]))

    def text(self) -> str:
        """The title on a line, then the map: ``R`` the robot, ``*`` where it has been."""
        robot_row, robot_column = self.place(self.robot)
        rows = _window(robot_row, len(self.rows), MAX_ROWS)
        columns = _window(robot_column, len(self.rows[0]), MAX_COLUMNS)
        trail = {self.place(cell) for step in self.steps for cell in step}
        marks = {(row, column): TRAIL for row, column in trail if self.rows[row][column] != "S"}
        marks[robot_row, robot_column] = ROBOT
        title = f"({self.title})"
        if len(rows) < len(self.rows) or len(columns) < len(self.rows[0]):
            title += f" rows {rows[0]}-{rows[-1]}, columns {columns[0]}-{columns[-1]}"
        lines = ["".join(marks.get((r, c), self.rows[r][c]) for c in columns) for r in rows]
        return "\n".join([title, *lines]) + "\n"


def _window(centre: int, length: int, most: int) -> range:
    """At most ``most`` indices around ``centre``."""
    first = max(0, min(centre - most // 2, length - most))
    return range(first, min(first + most, length))


class Renderer(ABC):
    """Shows scenes, as pixels or in a window; pygame is imported when the first one is drawn."""

    def __init__(self, fps: int, title: str) -> None:
        self.fps = fps  # pictures a second in a window
        self.title = title
        self._window: tuple[pygame.Surface, pygame.time.Clock] | None = None

    @abstractmethod
    def paint(self, scene: Any) -> pygame.Surface:
        """Draw a scene."""

    def pixels(self, scene: Any) -> NDArray[np.uint8]:
        """The picture of a scene, shape (height, width, 3)."""
        import pygame

        picture = self.paint(scene)
        return np.ascontiguousarray(pygame.surfarray.array3d(picture).swapaxes(0, 1))

    def show(self, scene: Any) -> None:
        """Draw a scene into the window, at most ``fps`` times a second."""
        import pygame

        picture = self.paint(scene)
        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption(self.title)
            window = pygame.display.set_mode(picture.get_size())
            self._window = window, pygame.time.Clock()
        window, clock = self._window
        window.blit(picture, (0, 0))
        pygame.event.pump()
        pygame.display.update()
        clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            import pygame

            pygame.display.quit()
            self._window = None


class BarsRenderer(Renderer):
    """Shows bars."""

    def paint(self, scene: Bars) -> pygame.Surface:
        import pygame

        picture = pygame.Surface((WIDTH, TITLE + ROW * len(scene.bars)))
        picture.fill(FLOOR)
        for shape in scene.shapes():
            _draw(picture, shape, 1)
        return picture


MAX_SIDE = 1024
MAX_CELL = 64
# In smaller cells shapes cannot be told apart: each is filled with one colour.
MIN_DETAILED_CELL = 12
# Start, goal and robot of such maps are drawn across cells, large enough to be seen.
MARKER = 28
# The width of the trail: a share of a cell, and at least so many pixels.
TRAIL_WIDTH, NARROWEST_TRAIL = 0.16, 5
OVERSAMPLING = 4


class GridRenderer(Renderer):
    """Shows scenes on one map, whose common background is drawn once."""

    def __init__(self, rows: tuple[str, ...], fps: int, title: str) -> None:
        super().__init__(fps, title)
        self.rows = rows
        self.n_columns = len(rows[0])
        longest = max(len(rows), self.n_columns)
        self.cell = min(max(MAX_SIDE // longest, 1), MAX_CELL)
        self.detailed = self.cell >= MIN_DETAILED_CELL
        self.marker = self.cell if self.detailed else MARKER
        self._sprites: dict[tuple[tuple[Shape, ...], int], pygame.Surface] = {}

    def paint(self, scene: Scene) -> pygame.Surface:
        import pygame

        picture = self._background.copy()
        for cell in scene.collected:
            if self.detailed:
                self._blit(picture, self._sprite(EMPTIED_SHAPES, self.cell), cell)
            else:
                area = pygame.Rect(0, 0, self.cell, self.cell)
                area.center = self._centre(cell)
                picture.fill(FLOOR, area)
        width = max(round(TRAIL_WIDTH * self.cell), NARROWEST_TRAIL)
        for step in scene.steps:
            first, last = (self._centre(cell) for cell in sorted(step))
            line = pygame.Rect(first, (last[0] - first[0], last[1] - first[1]))
            picture.fill(BLUE, line.inflate(width, width))
        row, column = scene.place(scene.robot)
        if self.rows[row][column] == "M":
            burst = self._sprite(BURST_SHAPES, self.marker * 3 // 2)
            self._blit(picture, burst, scene.robot)
        robot = self._sprite(ROBOT_SHAPES, self.marker)
        degrees = {None: 0, 0: 0, 1: 180, 2: 90, 3: 270}[scene.last_move]
        self._blit(picture, pygame.transform.rotate(robot, degrees), scene.robot)
        longest = max(picture.get_size())
        if longest <= MAX_SIDE:
            return picture
        size = (max(1, side * MAX_SIDE // longest) for side in picture.get_size())
        return pygame.transform.smoothscale(picture, tuple(size))

    @cached_property
    def _background(self) -> pygame.Surface:
        """The map as it is without the robot."""
        import pygame

        size = (self.n_columns * self.cell, len(self.rows) * self.cell)
        picture = pygame.Surface(size)
        picture.fill(FLOOR)
        if not self.detailed:
            table = np.zeros((128, 3), np.uint8)
            for letter, colour in LETTER_COLOURS.items():
                table[ord(letter)] = colour
            codes = np.frombuffer("".join(self.rows).encode("ascii"), np.uint8)
            pixels = table[codes.reshape(len(self.rows), self.n_columns)]
            pixels = pixels.repeat(self.cell, axis=0).repeat(self.cell, axis=1)
            pygame.surfarray.blit_array(picture, pixels.swapaxes(0, 1))
        drawn = LETTER_SHAPES.keys() if self.detailed else {"S", "G"}
        for row, letters in enumerate(self.rows):
            if not drawn.isdisjoint(letters):
                for column, letter in enumerate(letters):
                    if letter in drawn:
                        sprite = self._sprite(LETTER_SHAPES[letter], self.marker)
                        self._blit(picture, sprite, row * self.n_columns + column)
        if self.detailed:
            for x in range(self.cell, size[0], self.cell):
                pygame.draw.line(picture, GRID, (x, 0), (x, size[1]))
            for y in range(self.cell, size[1], self.cell):
                pygame.draw.line(picture, GRID, (0, y), (size[0], y))
        return picture

    def _blit(self, picture: pygame.Surface, sprite: pygame.Surface, cell: int) -> None:
        """Draw a sprite centred on a cell; markers stay inside the picture."""
        area = sprite.get_rect(center=self._centre(cell))
        picture.blit(sprite, area if self.detailed else area.clamp(picture.get_rect()))

    def _centre(self, cell: int) -> tuple[int, int]:
        """The pixel in the middle of a cell."""
        row, column = divmod(cell, self.n_columns)
        return column * self.cell + self.cell // 2, row * self.cell + self.cell // 2

    def _sprite(self, shapes: tuple[Shape, ...], size: int) -> pygame.Surface:
        """Shapes as a square picture with smooth edges, drawn once for each size."""
        import pygame

        if (shapes, size) not in self._sprites:
            large = pygame.Surface((size * OVERSAMPLING, size * OVERSAMPLING), pygame.SRCALPHA)
            for shape in shapes:
                _draw(large, shape, size * OVERSAMPLING)
            self._sprites[shapes, size] = pygame.transform.smoothscale(large, (size, size))
        return self._sprites[shapes, size]


def _draw(surface: pygame.Surface, shape: Shape, scale: int) -> None:
    import pygame

    def point(at: tuple[float, float]) -> tuple[int, int]:
        return round(at[0] * scale), round(at[1] * scale)

    match shape:
        case Polygon():
            pygame.draw.polygon(surface, shape.colour, [point(at) for at in shape.points])
        case Disc():
            width, radius = math.ceil(shape.width * scale), shape.radius * scale
            pygame.draw.circle(surface, shape.colour, point(shape.centre), radius, width)
        case Label():
            pygame.font.init()
            font = pygame.font.Font(None, round(shape.height * scale))
            text = font.render(shape.text, True, shape.colour)
            x, y = point(shape.at)
            surface.blit(text, (x - shape.align * text.get_width(), y - text.get_height() // 2))
        case _:
            area = pygame.Rect(point(shape.corner), point(shape.size))
            rounding = round(shape.rounding * scale)
            pygame.draw.rect(surface, shape.colour, area, border_radius=rounding)


RENDER_MODES = ("ansi", "rgb_array", "human")


class ShownEnv(gym.Env[Any, Any], ABC):
    """An environment with three render modes: ``ansi``, ``rgb_array`` and ``human``."""

    # Not annotated as ClassVar, since Gymnasium declares it as an attribute of the instance.
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 8}  # noqa: RUF012

    def __init__(self, render_mode: str | None) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self._renderer: Renderer | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Copies, pickled ones included, open their own window when they need it.
        return {**self.__dict__, "_renderer": None}

    def render(self) -> str | NDArray[np.uint8] | None:
        """As text (``ansi``), as a picture of shape (height, width, 3), or in a window."""
        if self.render_mode is None:
            gym.logger.warn("render() does nothing: the environment was made without render_mode")
            return None
        if self.render_mode == "ansi":
            return self._picture().text()
        if self._renderer is None:
            title = type(self).__name__ if self.spec is None else self.spec.id
            self._renderer = self._make_renderer(self.metadata["render_fps"], title)
        if self.render_mode == "rgb_array":
            return self._renderer.pixels(self._picture())
        self._renderer.show(self._picture())
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @abstractmethod
    def _picture(self) -> Scene | Bars:
        """The state as the renderer paints it."""

    def _make_renderer(self, fps: int, title: str) -> Renderer:
        """The renderer of the pictures, by default of bars."""
        return BarsRenderer(fps, title)


# --- amounts: the arms of bandits, and states without a map ---------------------------------------

# The length of a bar in a text, in characters.
LENGTH = 40
# In pixels.
WIDTH, MARGIN, TITLE, ROW, TEXT = 560, 24, 48, 44, 20


class Bar(NamedTuple):
    """A named bar from zero to a value."""

    name: str
    value: float | None  # None for no bar
    numbers: str  # the same in numbers
    mark: float | None = None  # a line across the bar
    is_latest: bool = False  # drawn darker


@dataclass(frozen=True)
class Bars:
    """Bars on one scale, with a title."""

    title: str
    bars: list[Bar]
    low: float  # the lowest value on the scale, at most 0
    high: float

    @classmethod
    def fitting(cls, title: str, bars: list[Bar], values: Iterable[float]) -> Bars:
        """Bars on a scale that includes zero and all values."""
        known = [0.0, *values]
        low, high = min(known), max(known)
        return cls(title, bars, low, high if high > low else low + 1)

    def part(self, value: float) -> float:
        """0 for the lowest value of the scale, 1 for the highest."""
        return (value - self.low) / (self.high - self.low)

    def text(self) -> str:
        """The title on a line, then a line for each bar: ``=`` the bar, ``|`` the mark."""
        longest = max(len(bar.name) for bar in self.bars)
        lines = [self.title]
        for bar in self.bars:
            cells = [" "] * LENGTH
            if bar.value is not None:
                ends = sorted(round(self.part(v) * (LENGTH - 1)) for v in (0.0, bar.value))
                cells[ends[0] : ends[1] + 1] = "=" * (ends[1] + 1 - ends[0])
            if bar.mark is not None:
                cells[round(self.part(bar.mark) * (LENGTH - 1))] = "|"
            name = f"{'>' if bar.is_latest else ' '} {bar.name:{longest}}"
            lines.append(f"{name}  {bar.numbers}  {''.join(cells)}".rstrip())
        return "\n".join(lines) + "\n"

    def shapes(self) -> list[Shape]:
        """The picture, the hindmost first, in pixels: names and numbers above each bar."""
        length, right = WIDTH - 2 * MARGIN, WIDTH - MARGIN
        shapes: list[Shape] = [Label(self.title, (MARGIN, TITLE / 2), TEXT + 4, INK, align=0)]
        for i, bar in enumerate(self.bars):
            top = TITLE + i * ROW
            shapes += [
                Label(bar.name, (MARGIN, top + 8), TEXT, INK, align=0),
                Label(bar.numbers, (right, top + 8), TEXT, INK, align=1),
                Box((MARGIN, top + 18), (length, 16), 3, GRID),
            ]
            if bar.value is not None:
                ends = sorted(MARGIN + length * self.part(v) for v in (0.0, bar.value))
                colour = DARK_BLUE if bar.is_latest else BLUE
                shapes.append(Box((ends[0], top + 18), (ends[1] - ends[0] + 1, 16), 3, colour))
            if bar.mark is not None:
                place = MARGIN + length * self.part(bar.mark)
                shapes.append(Box((place - 2, top + 15), (4, 22), 2, ORANGE))
        return shapes
