"""The picture of a value map: the agent's policy, and beside it the optimal ones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from envs.layout import GOAL, PRIZE, TRAP, WALL, GridLayout
from envs.sprites import INK, Colour
from pipeline.evaluation.value_maps import ValueMap
from pipeline.pictures.learning_curve import ORANGE
from pipeline.pictures.map_cells import (
    BELOW,
    BELOW_HATCH,
    GROUND,
    MARKS,
    SMALLEST_FONT,
    Policy,
    draw_arrows,
    draw_grid,
    draw_ground,
    draw_marks,
    draw_numbers,
    is_below,
    mark_differing,
    policies_in,
    shade,
)
from pipeline.pictures.picture_files import fix_layout, write_png

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

# Pale enough for dark arrows and numbers; in print and to colour-blind readers, darker is better.
VALUE_COLOURS = ("#FFFBD6", "#D3ECC0", "#8FD0C0", "#55B0CC", "#4A97CF")
MAX_LAYERS = 4
MAX_TICKS = 6
DIM = "#777777"
MARGIN = 1.3  # inches, for title, legend and colour bar


def draw_value_map(path: Path, title: str, found: ValueMap) -> None:
    """Draw a map into a file.

    Colours are exact values on the scale of the optimal ones. Of a map with prizes, those layers
    are drawn that the agent or an optimal policy comes to, up to four.

    Args:
        path: of the PNG file.
        title: what stands above the picture.
        found: the map.
    """
    layers, cell = shown_layers(found), cell_inches(found.layout)
    scale, colours = _value_scale(found)
    decimals = decimals_for(found)
    figure, pairs = _panels(found.layout, len(layers), cell)
    _name_panels(pairs, found, layers)
    _explain(figure, found, scale, colours)
    figure.suptitle(title, x=0.01, ha="left")
    # What stands inside the panels needs no room around them. Fixed now, the layout is worked
    # out once, and without asking hundreds of numbers for their size.
    fix_layout(figure)
    for pair, layer in zip(pairs, layers, strict=True):
        for axes, policy in zip(pair, policies_in(found, layer), strict=True):
            draw_ground(axes, policy, scale, colours)
            _draw_policy(axes, policy, 72 * cell, decimals, thick=axes is pair[0])
    write_png(figure, path)


def shown_layers(found: ValueMap) -> list[int]:
    """The layers to draw, those with the fewest prizes collected first."""
    come_to = found.matters & (found.visited | found.optimal_visited)
    layers = np.unique(found.layout.layers[come_to]).tolist()
    return sorted(layers, key=lambda layer: (layer.bit_count(), layer))[:MAX_LAYERS]


def layer_name(layout: GridLayout, layer: int) -> str:
    """What is collected in a layer, in words."""
    cells = layout.collected_in(layer)
    if not cells:
        return "nothing collected"
    places = [layout.place_name(cell) for cell in cells]
    return f"{layout.names.get(PRIZE, 'prize')} collected at " + "; ".join(places)


def cell_inches(layout: GridLayout) -> float:
    """The width of a cell, so that small maps are not tiny and large ones fit on a screen."""
    longest = max(layout.n_rows, layout.n_columns)
    return min(max(0.5 * longest, 3.2), 9.0 if _is_wide(layout) else 7.0) / longest


def decimals_for(found: ValueMap) -> int:
    """Decimals that tell values apart: none where all of them are whole."""
    values = np.concatenate([found.values[found.matters], found.optimal_values[found.matters]])
    if np.abs(values - np.round(values)).max() < 1e-9:
        return 0
    best = found.optimal_values[found.matters]
    return 2 if np.ptp(best) < 10 else 1


def _is_wide(layout: GridLayout) -> bool:
    """Whether panels look better above each other."""
    return layout.n_columns >= 2 * layout.n_rows


def _panels(layout: GridLayout, n_layers: int, cell: float) -> tuple[Figure, list[list[Axes]]]:
    """A figure with two empty panels for each layer, cells ``cell`` inches wide."""
    from matplotlib.figure import Figure

    n_rows, n_columns = (2 * n_layers, 1) if _is_wide(layout) else (n_layers, 2)
    width = n_columns * (cell * layout.n_columns + 0.3) + MARGIN
    height = n_rows * (cell * layout.n_rows + 0.35) + MARGIN
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False)
    longest = max(layout.n_rows, layout.n_columns)
    # Labels cost more time than anything else.
    step = next(step for step in (1, 2, 5, 10, longest) if longest <= MAX_TICKS * step)
    for number, axes in enumerate(panels.flat):
        named = number % n_columns == 0
        axes.set(
            xlim=(-0.5, layout.n_columns - 0.5),
            ylim=(layout.n_rows - 0.5, -0.5),
            aspect="equal",
        )
        # Counted from 1, as everywhere.
        for axis, length in ((axes.xaxis, layout.n_columns), (axes.yaxis, layout.n_rows)):
            shown = range(step - 1, length if named or axis is axes.xaxis else 0, step)
            axis.set_ticks(shown, [str(place + 1) for place in shown])
        axes.tick_params(length=0, labelsize=7, labelcolor=DIM, pad=2)
        axes.spines[:].set_visible(False)
    return figure, panels.reshape(-1, 2).tolist()


def _value_scale(found: ValueMap) -> tuple[Normalize, Colormap]:
    """From the lowest optimal value to the highest."""
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    best = found.optimal_values[found.matters]
    low, high = float(best.min()), float(best.max())
    scale = Normalize(low, high if high > low else low + 1)
    return scale, LinearSegmentedColormap.from_list("values", VALUE_COLOURS)


def _draw_policy(axes: Axes, policy: Policy, cell: float, decimals: int, *, thick: bool) -> None:
    font = min(0.2 * cell, 9.0)
    with_numbers = font >= SMALLEST_FONT
    draw_grid(axes, policy.layout, cell)
    draw_marks(axes, policy, cell)
    draw_arrows(axes, policy, min(2.9 / cell, 0.085) * (1 if thick else 0.5), with_numbers)
    if with_numbers:
        draw_numbers(axes, policy, font, decimals)
    mark_differing(axes, policy, cell)


def _name_panels(pairs: list[list[Axes]], found: ValueMap, layers: list[int]) -> None:
    names = (("agent", found.values), ("optimum, all best actions", found.optimal_values))
    for axes, (name, values) in zip(pairs[0], names, strict=True):
        start_value = f"{found.initial @ values:,.2f}".replace("-", "\N{MINUS SIGN}")
        axes.set_title(f"{name}: return {start_value}", fontsize=10, loc="left")
    for pair, layer in zip(pairs, layers, strict=True):
        if found.layout.prizes:
            pair[0].set_ylabel(layer_name(found.layout, layer))


def _explain(figure: Figure, found: ValueMap, scale: Normalize, colours: Colormap) -> None:
    """The colour bar and the legend."""
    from matplotlib.cm import ScalarMappable

    source = ScalarMappable(scale, colours)
    bar = figure.colorbar(source, ax=figure.axes, aspect=30, pad=0.02)
    bar.set_label("expected return from here on")
    bar.ax.spines[:].set_visible(False)
    figure.legend(
        handles=list(_legend(found, scale)),
        loc="outside lower left",
        ncols=int(np.clip(figure.get_figwidth() / 2.6, 1, 4)),
        fontsize=9,
        frameon=False,
    )


def _legend(found: ValueMap, scale: Normalize) -> Iterator[Artist]:
    """An entry for each thing that the picture shows."""
    from matplotlib.patches import Patch

    yield _sample(INK, ">", 6, "on the way from the start", linewidth=2)
    yield _sample(INK, ">", 6, "elsewhere", linewidth=1.5, alpha=0.45)
    differs = f"not an optimal action ({found.differs.sum()} of {found.matters.sum()} states)"
    yield Patch(facecolor="none", edgecolor=ORANGE, linewidth=2, label=differs)
    if is_below(found.values[found.matters], scale).any():
        label = "worth less than the scale shows"
        yield Patch(facecolor=shade(BELOW), edgecolor=shade(BELOW_HATCH), hatch="////", label=label)
    letters = set("".join(found.layout.rows))
    words = {GOAL: "goal", TRAP: "trap", WALL: "wall", PRIZE: "prize", **found.layout.names}
    if WALL in letters:
        yield Patch(color=shade(GROUND[WALL]), label=words[WALL])
    for letter, (marker, size, colour) in MARKS.items():
        if letter in letters:
            yield _sample(colour, marker, 8 + 6 * size, words[letter], linewidth=0)


def _sample(
    colour: Colour, marker: str, size: float, label: str, linewidth: float, alpha: float = 1.0
) -> Artist:
    from matplotlib.lines import Line2D

    line = Line2D([], [], color=shade(colour), linewidth=linewidth, alpha=alpha, label=label)
    line.set(marker=marker, markersize=size, markeredgecolor=shade(INK))
    return line
