"""Amounts shown as bars: the arms of bandits, and the states of environments without a map."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from rl_yardstick.envs.drawing import (
    BLUE,
    DARK_BLUE,
    GRID,
    INK,
    ORANGE,
    Box,
    Chart,
    ChartRenderer,
    Label,
    Shape,
    ShownEnv,
)

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

    def chart(self) -> Chart:
        """The picture: names and numbers above each bar."""
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
        return Chart((WIDTH, TITLE + ROW * len(self.bars)), shapes)


class BarsEnv(ShownEnv):
    """An environment that is shown as bars."""

    @abstractmethod
    def _bars(self) -> Bars:
        """The state as bars."""

    def _text(self) -> str:
        return self._bars().text()

    def _picture(self) -> Chart:
        return self._bars().chart()

    def _make_renderer(self, fps: int, title: str) -> ChartRenderer:
        return ChartRenderer(fps, title)
