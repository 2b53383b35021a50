"""Environments as pictures and in a window; the only module that draws with pygame.

pygame is imported when the first picture is drawn.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from envs import sprites
from envs.scene import Chart, Scene
from envs.sprites import Disc, Label, Polygon, Ring, Shape

if TYPE_CHECKING:
    import pygame

MAX_SIDE = 1024
MAX_CELL = 64
# In smaller cells shapes cannot be told apart: each is filled with one colour.
MIN_DETAILED_CELL = 12
# Start, goal and robot of such maps are drawn across cells, large enough to be seen.
MARKER = 28
# By how many pixels the trail there is wider than one.
TRAIL_MARKER = 4
OVERSAMPLING = 4


class GridPainter:
    """Draws the moments of one map; what they have in common is drawn once.

    Args:
        rows: the map.
    """

    def __init__(self, rows: tuple[str, ...]) -> None:
        self.rows = rows
        self.n_columns = len(rows[0])
        longest = max(len(rows), self.n_columns)
        self.cell = min(max(MAX_SIDE // longest, 1), MAX_CELL)
        self.detailed = self.cell >= MIN_DETAILED_CELL
        self._sprites: dict[tuple[tuple[Shape, ...], int], pygame.Surface] = {}

    def paint(self, scene: Scene) -> pygame.Surface:
        """Draw a scene."""
        import pygame

        picture = self._detailed(scene) if self.detailed else self._coarse(scene)
        longest = max(picture.get_size())
        if longest <= MAX_SIDE:
            return picture
        width, height = (max(1, side * MAX_SIDE // longest) for side in picture.get_size())
        return pygame.transform.smoothscale(picture, (width, height))

    def _detailed(self, scene: Scene) -> pygame.Surface:
        picture = self._background.copy()
        for cell in scene.collected:
            self._put(picture, sprites.EMPTIED_SHAPES, cell)
        for cell, sides in self._sides(scene).items():
            self._put(picture, sprites.trail_shapes(frozenset(sides)), cell)
        self._put_robot(picture, scene, self.cell)
        return picture

    def _coarse(self, scene: Scene) -> pygame.Surface:
        import pygame

        colours = self._colours.copy()
        colours.reshape(-1, 3)[list(scene.collected)] = sprites.FLOOR
        pixels = colours.repeat(self.cell, axis=0).repeat(self.cell, axis=1)
        picture = pygame.surfarray.make_surface(pixels.swapaxes(0, 1))
        for step in scene.steps:
            first, last = (self._centre(cell) for cell in sorted(step))
            area = pygame.Rect(first, (last[0] - first[0] + 1, last[1] - first[1] + 1))
            picture.fill(sprites.BLUE, area.inflate(TRAIL_MARKER, TRAIL_MARKER))
        for cell, letter in self._landmarks:
            self._put(picture, sprites.LETTER_SHAPES[letter], cell, MARKER)
        self._put_robot(picture, scene, MARKER)
        return picture

    @cached_property
    def _background(self) -> pygame.Surface:
        """Floor, lines between its cells, and all that stands on it."""
        import pygame

        size = (self.n_columns * self.cell, len(self.rows) * self.cell)
        picture = pygame.Surface(size)
        picture.fill(sprites.FLOOR)
        for row, letters in enumerate(self.rows):
            for column, letter in enumerate(letters):
                if letter in sprites.LETTER_SHAPES:
                    cell = row * self.n_columns + column
                    self._put(picture, sprites.LETTER_SHAPES[letter], cell)
        for x in range(self.cell, size[0], self.cell):
            pygame.draw.line(picture, sprites.GRID, (x, 0), (x, size[1]))
        for y in range(self.cell, size[1], self.cell):
            pygame.draw.line(picture, sprites.GRID, (0, y), (size[0], y))
        return picture

    @cached_property
    def _colours(self) -> NDArray[np.uint8]:
        """One colour for each cell, shape (rows, columns, 3)."""
        table = np.zeros((128, 3), np.uint8)
        for letter, colour in sprites.LETTER_COLOURS.items():
            table[ord(letter)] = colour
        codes = np.frombuffer("".join(self.rows).encode("ascii"), np.uint8)
        return table[codes].reshape(len(self.rows), self.n_columns, 3)

    @cached_property
    def _landmarks(self) -> list[tuple[int, str]]:
        """Cells of the start and the goals."""
        return [
            (row * self.n_columns + column, letter)
            for row, letters in enumerate(self.rows)
            if "S" in letters or "G" in letters
            for column, letter in enumerate(letters)
            if letter in "SG"
        ]

    def _sides(self, scene: Scene) -> dict[int, set[int]]:
        """Through which sides the trail leaves each of its cells: 0 up, 1 down, 2 left, 3 right."""
        # The keys would coincide on a map of one column, where left and right do not occur.
        side_of = {-1: 2, 1: 3} | {-self.n_columns: 0, self.n_columns: 1}
        sides: dict[int, set[int]] = defaultdict(set)
        for origin, target in scene.steps:
            sides[origin].add(side_of[target - origin])
            sides[target].add(side_of[origin - target])
        return sides

    def _put_robot(self, picture: pygame.Surface, scene: Scene, size: int) -> None:
        import pygame

        row, column = scene.place(scene.robot)
        if self.rows[row][column] == "M":
            self._put(picture, sprites.BURST_SHAPES, scene.robot, size * 3 // 2)
        robot = self._sprite(sprites.ROBOT_SHAPES, size)
        degrees = {None: 0, 0: 0, 1: 180, 2: 90, 3: 270}[scene.last_action]
        self._blit(picture, pygame.transform.rotate(robot, degrees), scene.robot)

    def _put(
        self,
        picture: pygame.Surface,
        shapes: tuple[Shape, ...],
        cell: int,
        size: int | None = None,
    ) -> None:
        self._blit(picture, self._sprite(shapes, size or self.cell), cell)

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


class Renderer(ABC):
    """Shows scenes, as pixels or in a window.

    Copies, pickled ones included, share no window: they open their own when they need it.

    Args:
        fps: pictures a second in a window.
        title: what the window is called.
    """

    def __init__(self, fps: int, title: str) -> None:
        self.fps = fps
        self.title = title
        self._window: pygame.Surface | None = None
        self._clock: pygame.time.Clock | None = None

    @abstractmethod
    def paint(self, scene: Any) -> pygame.Surface:
        """Draw a scene."""

    def pixels(self, scene: Any) -> NDArray[np.uint8]:
        """The picture of a scene, shape (height, width, 3)."""
        import pygame

        picture = self.paint(scene)
        return np.ascontiguousarray(pygame.surfarray.array3d(picture).swapaxes(0, 1))

    def show(self, scene: Any) -> None:
        """Draw a scene into the window, no sooner than the time for it has come."""
        import pygame

        picture = self.paint(scene)
        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption(self.title)
            self._window = pygame.display.set_mode(picture.get_size())
            self._clock = pygame.time.Clock()
        assert self._clock is not None
        self._window.blit(picture, (0, 0))
        pygame.event.pump()
        pygame.display.update()
        self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            import pygame

            pygame.display.quit()
            self._window = None


class GridRenderer(Renderer):
    """Shows one map.

    Args:
        rows: the map.
        fps: see `Renderer`.
        title: see `Renderer`.
    """

    def __init__(self, rows: tuple[str, ...], fps: int, title: str) -> None:
        super().__init__(fps, title)
        self.rows = rows
        self._painter = GridPainter(rows)

    def __reduce__(self) -> tuple[type[GridRenderer], tuple[tuple[str, ...], int, str]]:
        return GridRenderer, (self.rows, self.fps, self.title)

    def paint(self, scene: Scene) -> pygame.Surface:
        return self._painter.paint(scene)


class ChartRenderer(Renderer):
    """Shows charts."""

    def __reduce__(self) -> tuple[type[ChartRenderer], tuple[int, str]]:
        return ChartRenderer, (self.fps, self.title)

    def paint(self, scene: Chart) -> pygame.Surface:
        import pygame

        picture = pygame.Surface(scene.size)
        picture.fill(sprites.FLOOR)
        for shape in scene.shapes:
            _draw(picture, shape, 1)
        return picture


def _draw(surface: pygame.Surface, shape: Shape, scale: int) -> None:
    import pygame

    def point(at: tuple[float, float]) -> tuple[int, int]:
        return round(at[0] * scale), round(at[1] * scale)

    match shape:
        case Polygon():
            pygame.draw.polygon(surface, shape.colour, [point(at) for at in shape.points])
        case Disc():
            pygame.draw.circle(surface, shape.colour, point(shape.centre), shape.radius * scale)
        case Ring():
            width = max(1, round(shape.width * scale))
            radius = shape.radius * scale
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
