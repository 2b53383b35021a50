"""Amounts as text and as bars, for environments whose state is one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from envs import sprites
from envs.scene import Chart
from envs.sprites import Box, Label, Shape

# In characters.
BAR = 40
# In pixels.
WIDTH, MARGIN, TITLE, ROW, TEXT = 560, 24, 48, 64, 22


class Gauge(NamedTuple):
    """An amount between nothing and full."""

    name: str
    amount: int
    full: int


def gauges_text(title: str, gauges: Sequence[Gauge]) -> str:
    """The title on a line, then a line for each gauge."""
    longest = max(len(gauge.name) for gauge in gauges)
    lines = [f"({title})"]
    for name, amount, full in gauges:
        bar = "=" * round(BAR * amount / full)
        lines.append(f"{name:{longest}}  {amount:>{len(str(full))}}/{full} |{bar:{BAR}}|")
    return "\n".join(lines) + "\n"


def gauges_chart(title: str, gauges: Sequence[Gauge]) -> Chart:
    """The title, then a bar for each gauge below its name and numbers."""
    shapes: list[Shape] = [Label(title, (MARGIN, TITLE / 2), TEXT + 4, sprites.INK, align=0)]
    length = WIDTH - 2 * MARGIN
    for i, (name, amount, full) in enumerate(gauges):
        top = TITLE + i * ROW
        right = WIDTH - MARGIN
        shapes += [
            Label(name, (MARGIN, top + 8), TEXT, sprites.INK, align=0),
            Label(f"{amount} of {full}", (right, top + 8), TEXT, sprites.INK, align=1),
            Box((MARGIN, top + 22), (length, 24), 4, sprites.GRID),
            Box((MARGIN, top + 22), (length * amount / full, 24), 4, sprites.BLUE),
        ]
    return Chart((WIDTH, TITLE + ROW * len(gauges)), shapes)
