"""A policy drawn on the map of a grid world: colours, numbers and arrows in its cells.

Columns count along the horizontal axis, rows down the vertical one, and a cell's middle lies at
whole numbers. ``cell`` is the width of a cell in points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from envs.layout import GOAL, PRIZE, START, TRAP, WALL, GridLayout
from envs.sprites import FLOOR, GREEN, INK, PALE_GREEN, PALE_RED, SHELF, WHITE, Colour
from envs.sprites import ORANGE as AMBER
from mdp.array_types import Bools, Floats, Ints
from pipeline.evaluation.value_maps import ValueMap
from pipeline.pictures.learning_curve import ORANGE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize


BELOW: Colour = (222, 222, 222)
BELOW_HATCH: Colour = (196, 196, 196)
GROUND = {WALL: SHELF, GOAL: PALE_GREEN, TRAP: PALE_RED}
# Marker, its size as a share of the cell, its colour.
MARKS = {GOAL: ("*", 0.55, GREEN), TRAP: ("X", 0.36, INK), PRIZE: ("D", 0.15, AMBER)}
# Points; below these, numbers and grid lines are noise.
SMALLEST_FONT = 5.5
SMALLEST_GRID = 8.0


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy in one layer of the map; arrays have an entry for each cell, row by row.

    Attributes:
        layout: the map.
        layer: which prizes are collected.
        matters: where the agent may have to act, bool.
        visited: where the policy comes to from the start, bool.
        differs: where agent and optimum part, bool.
        values: expected return from there on.
        actions: the actions to draw, bool of shape (cells, A).
    """

    layout: GridLayout
    layer: int
    matters: Bools
    visited: Bools
    differs: Bools
    values: Floats
    actions: Bools

    def places(self, chosen: Bools) -> tuple[Ints, Ints]:
        """Columns and rows of the chosen cells."""
        rows, columns = np.divmod(np.flatnonzero(chosen), self.layout.n_columns)
        return columns, rows


def policies_in(found: ValueMap, layer: int) -> tuple[Policy, Policy]:
    """The agent's policy and the optimal ones in one layer."""
    here = found.layout.layers == layer
    taken = np.eye(len(found.layout.moves), dtype=np.bool_)[found.actions]
    common = (found.layout, layer, found.matters[here])
    differs = found.differs[here]
    return (
        Policy(*common, found.visited[here], differs, found.values[here], taken[here]),
        Policy(
            *common,
            found.optimal_visited[here],
            differs,
            found.optimal_values[here],
            found.optimal_actions[here],
        ),
    )


def draw_ground(axes: Axes, policy: Policy, scale: Normalize, colours: Colormap) -> None:
    """Colour the cells: by their value where the agent acts, else by what stands there."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    letters = np.array([list(row) for row in policy.layout.rows_in(policy.layer)])
    picture = np.empty((*letters.shape, 3))
    picture[:] = shade(FLOOR)
    for letter, colour in GROUND.items():
        picture[letters == letter] = shade(colour)
    matters = policy.matters.reshape(letters.shape)
    picture[matters] = colours(np.clip(scale(policy.values), 0, 1))[policy.matters, :3]
    # As a mesh: an image would be sampled anew for every pixel.
    n_rows, n_columns = letters.shape
    axes.pcolormesh(np.arange(n_columns + 1) - 0.5, np.arange(n_rows + 1) - 0.5, picture)
    low = policy.matters & is_below(policy.values, scale)
    below = [Rectangle((x - 0.5, y - 0.5), 1, 1) for x, y in zip(*policy.places(low), strict=True)]
    axes.add_collection(
        PatchCollection(
            below, facecolor=shade(BELOW), edgecolor=shade(BELOW_HATCH), hatch="////", linewidth=0
        )
    )


def is_below(values: Floats, scale: Normalize) -> Bools:
    """Which values lie below the scale, and by more than rounding."""
    return np.asarray(scale(values) < -1e-9)


def draw_grid(axes: Axes, layout: GridLayout, cell: float) -> None:
    """Lines between the cells."""
    if cell >= SMALLEST_GRID:
        colour, width = shade(WHITE), min(cell / 30, 1.0)
        rows, columns = np.arange(layout.n_rows) + 0.5, np.arange(layout.n_columns) + 0.5
        axes.hlines(rows[:-1], -0.5, columns[-1], color=colour, linewidth=width)
        axes.vlines(columns[:-1], -0.5, rows[-1], color=colour, linewidth=width)


def draw_marks(axes: Axes, policy: Policy, cell: float) -> None:
    """Goals, traps, prizes and starts."""
    letters = np.array(list("".join(policy.layout.rows_in(policy.layer))))
    for letter, (marker, size, colour) in MARKS.items():
        columns, rows = policy.places(letters == letter)
        # A prize leaves room for what is to do there.
        aside = 0.32 if letter == PRIZE else 0.0
        axes.scatter(
            columns + aside,
            rows - aside,
            marker=marker,
            s=(size * cell) ** 2,
            color=shade(colour),
            edgecolor=shade(INK),
            linewidth=cell / 60,
        )
    for x, y in zip(*policy.places(letters == START), strict=True):
        axes.text(
            x - 0.39,
            y - 0.38,
            "S",
            fontsize=min(max(0.22 * cell, 4), 12),
            fontweight="bold",
            ha="left",
            va="top",
            color=shade(INK),
            in_layout=False,
        )


def draw_arrows(axes: Axes, policy: Policy, width: float, with_numbers: bool) -> None:
    """An arrow for each action, dark where the policy comes to from the start.

    One that stays has a ring. A single action has its arrow in the middle of the cell, several set
    out from there; both are shorter, and higher up, where a number stands below. ``width`` is a
    share of the cell.
    """
    moves = np.array(policy.layout.moves)
    lift, reach = (0.1, 0.25) if with_numbers else (0.0, 0.33)
    for visited, weight, strength in ((False, 0.75, 0.45), (True, 1.0, 1.0)):
        shown = policy.matters & (policy.visited == visited)
        cells, actions = np.nonzero(policy.actions & shown[:, None])
        rows, columns = np.divmod(cells, policy.layout.n_columns)
        down, right = reach * moves[actions].T
        single = policy.actions.sum(axis=1)[cells] == 1
        axes.quiver(
            columns - np.where(single, right, 0),
            rows - lift - np.where(single, down, 0),
            np.where(single, 2, 1) * right,
            np.where(single, 2, 1) * down,
            angles="xy",
            units="xy",
            scale_units="xy",
            scale=1,
            width=weight * width,
            headwidth=4,
            headlength=4,
            headaxislength=3.6,
            minlength=0,
            color=shade(INK),
            alpha=strength,
            zorder=3,
        )
        still = (moves[actions] == 0).all(axis=1)
        if still.any():
            _draw_rings(axes, columns[still], rows[still] - lift, weight * width, strength)


def _draw_rings(axes: Axes, columns: Ints, rows: Ints, width: float, strength: float) -> None:
    """A ring for each action that stays where it is; ``width`` is a share of the cell."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Annulus

    rings = [Annulus((x, y), 0.12, width) for x, y in zip(columns, rows, strict=True)]
    axes.add_collection(
        PatchCollection(rings, facecolor=shade(INK), linewidth=0, alpha=strength, zorder=3)
    )


def draw_numbers(axes: Axes, policy: Policy, font: float, decimals: int) -> None:
    """The values at the foot of the cells, ``font`` points high."""
    columns, rows = policy.places(policy.matters)
    for x, y, value in zip(columns, rows, policy.values[policy.matters], strict=True):
        axes.text(
            x,
            y + 0.29,
            short_number(value, decimals),
            fontsize=font,
            ha="center",
            va="center_baseline",
            color=shade(INK),
            in_layout=False,
        )


def mark_differing(axes: Axes, policy: Policy, cell: float) -> None:
    """A frame inside the cells where the agent's action is not an optimal one."""
    from matplotlib.collections import LineCollection

    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * 0.44
    centres = np.stack(policy.places(policy.differs), axis=-1)
    axes.add_collection(
        LineCollection(
            list(centres[:, None] + corners),
            color=ORANGE,
            linewidth=min(max(cell / 16, 1.0), 2.4),
            joinstyle="miter",
            zorder=4,
        )
    )


def short_number(value: float, decimals: int) -> str:
    """A value in few characters: no decimals from 100 on, thousands as ``k``, millions as ``M``.

    The minus is the sign of that name, and a value that rounds to zero has none.
    """
    size = abs(value)
    if size >= 999_500:
        text = f"{size / 1e6:.1f}M"
    elif size >= 9_999.5:
        text = f"{size / 1e3:.0f}k"
    else:
        text = f"{size:.{decimals if size < 99.5 else 0}f}"
    return f"\N{MINUS SIGN}{text}" if value < 0 and text.strip("0.") else text


def shade(colour: Colour) -> tuple[float, float, float]:
    """A colour as Matplotlib takes it."""
    red, green, blue = colour
    return red / 255, green / 255, blue / 255
