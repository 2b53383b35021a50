"""The pictures of a run: its learning curve, and a policy with its values on a grid world's map.

On maps, columns are on the horizontal axis, rows on the vertical one, downwards; the centre of a
cell has integer coordinates. ``cell`` is the width of a cell in points.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rl_yardstick.envs.drawing import FLOOR, GREEN, INK, PALE_GREEN, PALE_RED, SHELF, WHITE, Colour
from rl_yardstick.envs.drawing import ORANGE as AMBER
from rl_yardstick.envs.layout import GOAL, PRIZE, START, TRAP, WALL, GridLayout
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.environments import training_changes
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.run import read_episodes
from rl_yardstick.safe_files.files import NO_LIMIT

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

    from rl_yardstick.pipeline.evaluation.value_maps import ValueMap


def load_matplotlib() -> None:
    """Load Matplotlib without its tables of help texts, which take half of the time."""
    from matplotlib import artist

    made, artist.kwdoc = artist.kwdoc, lambda artist: ""
    import matplotlib.pyplot as plt  # noqa: F401

    artist.kwdoc = made


def draw(folder: Path, parts: Any) -> None:
    """Draw what a training has left into its folder; ``parts`` is the `Training`, at its end."""
    spec, evaluation, agent = parts.spec, parts.evaluation, parts.agent
    if not spec.pictures:
        return
    from rl_yardstick.pipeline.evaluation.value_maps import value_map

    with parts.run.console.status("drawing the pictures"):
        load_matplotlib()
        if parts.pulled is None or evaluation.evaluations_timesteps:
            scale = None if parts.final is None else parts.final.yardstick
            means = [float(np.mean(row)) for row in evaluation.evaluations_results]
            evaluations = dict(zip(evaluation.evaluations_timesteps, means, strict=True))
            final = {} if parts.final is None else {agent.num_timesteps: parts.final.mean_return}
            places = folder, spec.title, evaluations | final, agent._num_timesteps_at_start, scale
            draw_learning_curve(*places, on_variant=bool(training_changes(spec)))
        if evaluation.value_maps is not None and evaluation.is_asked_for:
            found = value_map(evaluation.value_maps.evaluator, agent)
            if found is not None:
                draw_value_map(folder / "value_map.png", spec.title, found)


# --- learning curves ------------------------------------------------------------------------------


def fix_layout(figure: Figure) -> None:
    """Compute the layout now; artists that are added later do not change it."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure with its layout fixed; `Figure.savefig` would draw everything twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    fix_layout(figure)
    canvas: Any = FigureCanvasAgg(figure)
    with replacing(path) as beside:
        canvas.print_png(beside)


# Okabe and Ito's colours, which colour-blind readers can distinguish.
BLUE = "#0072B2"
ORANGE = "#D55E00"
OPTIMAL = "#009E73"
GREY = "#9A9A9A"

MOVING_AVERAGE_EPISODES = 100
MAX_POINTS = 5000


def read_monitors(folder: Path) -> tuple[Floats, Floats]:
    """For each training episode, its last step counted over all environments, and its return."""
    if not any(folder.glob("*.monitor.csv")):
        return np.empty(0), np.empty(0)
    found = read_episodes(folder, NO_LIMIT)
    return found.steps, found.returns


def draw_learning_curve(
    folder: Path,
    title: str,
    evaluations: Mapping[int, float],
    first_step: int,
    yardstick: Yardstick | None,
    *,
    on_variant: bool,
) -> None:
    """Draw training returns, from ``first_step`` on, and evaluations by steps into a folder."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    steps, returns = read_monitors(folder)
    # Returns of a variant of the environment have a scale of their own.
    apart = on_variant and len(steps) > 0 and (len(evaluations) > 0 or yardstick is not None)
    ratios = (3, 2) if apart else (1,)
    panels = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)
    judged, trained = panels[0, 0], panels[-1, 0]
    judged.set_ylabel("return of an episode")
    trained.set_xlabel("environment steps")
    if apart:
        trained.set_ylabel("training return")
        trained.set_title("training, on a variant of the environment", loc="left", fontsize=10)
    if len(steps):
        what = "training on a variant" if on_variant and not apart else "training"
        _draw_training(trained, steps + first_step, returns, what)
    if evaluations:
        style: Any = {"color": BLUE, "markersize": 4, "label": "evaluation, mean return"}
        judged.plot(list(evaluations), list(evaluations.values()), "o-", **style)
    if yardstick is not None:
        most = "optimum, at most" if yardstick.is_proven else "optimum, at most (not proven)"
        ends: dict[str, tuple[float | None, str]] = {
            "optimum" if yardstick.at_least is None else most: (yardstick.optimum, "-"),
            "optimum, at least": (yardstick.at_least, "--"),
            "best random or constant policy": (yardstick.baseline, ":"),
        }
        for label, (height, dash) in ends.items():
            if height is not None:
                judged.axhline(height, color=OPTIMAL, linestyle=dash, linewidth=1.2, label=label)
    judged.set_title(title, loc="left")
    for axes in panels.flat:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    # Below the axes, where the legend covers no points.
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9, markerscale=2)
    write_png(figure, folder / "learning_curve.png")


def _draw_training(axes: Axes, steps: Floats, returns: Floats, what: str) -> None:
    stride = max(len(steps) // MAX_POINTS, 1)
    label = f"{what}, " + ("each episode" if stride == 1 else f"1 episode in {stride}")
    style: Any = {"color": GREY, "markersize": 3, "markeredgewidth": 0, "label": label}
    axes.plot(steps[::stride], returns[::stride], "o", **style)
    if (width := min(MOVING_AVERAGE_EPISODES, len(returns))) > 1:
        counts = np.minimum(np.arange(1, len(returns) + 1), width)
        smooth = (np.convolve(returns, np.ones(width))[: len(returns)] / counts)[::stride]
        axes.plot(steps[::stride], smooth, color=ORANGE, label=f"{what}, mean of {width} episodes")


# --- maps -----------------------------------------------------------------------------------------


def shade(colour: Colour) -> tuple[float, float, float]:
    """Convert a colour for Matplotlib."""
    red, green, blue = colour
    return red / 255, green / 255, blue / 255


BLACK = shade(INK)
# A value below the scale.
GREYS = {"facecolor": shade((222, 222, 222)), "edgecolor": shade((196, 196, 196))}
BELOW: Any = {**GREYS, "hatch": "////"}
GROUND = {WALL: SHELF, GOAL: PALE_GREEN, TRAP: PALE_RED}
# Marker, its size as a share of the cell, and its colour.
MARKS = {GOAL: ("*", 0.55, GREEN), TRAP: ("X", 0.36, INK), PRIZE: ("D", 0.15, AMBER)}
# In points; in smaller cells, numbers and grid lines are left out.
SMALLEST_FONT = 5.5
SMALLEST_GRID = 8.0


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy in one layer of the map; arrays have one entry for each cell, row by row."""

    layout: GridLayout
    layer: int  # the set of collected prizes
    matters: Bools  # the cells to draw values and actions in
    differs: Bools  # where agent and optimum differ
    visited: Bools  # the cells that the policy reaches from the start
    values: Floats  # expected return from each cell on
    actions: Bools  # the actions to draw, shape (cells, A)

    def places(self, chosen: Bools) -> tuple[Ints, Ints]:
        """The columns and rows of the chosen cells."""
        rows, columns = np.divmod(np.flatnonzero(chosen), self.layout.n_columns)
        return columns, rows


def policy_in(found: ValueMap, layer: int, is_best: bool) -> Policy:
    """The agent's policy, or the optimal ones, in one layer."""
    which = found.optimal_visited, found.optimal_values, found.optimal_actions
    if not is_best:
        taken = np.eye(len(found.layout.moves), dtype=np.bool_)[found.actions]
        which = found.visited, found.values, taken
    arrays, here = (found.matters, found.differs, *which), found.layout.layers == layer
    return Policy(found.layout, layer, *(array[here] for array in arrays))


def draw_ground(axes: Axes, policy: Policy, scale: Normalize, colours: Colormap) -> None:
    """Colour the cells: by value where the agent acts, else by their contents."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    letters = np.array([list(row) for row in policy.layout.rows_in(policy.layer)])
    picture = np.empty((*letters.shape, 3))
    picture[:] = shade(FLOOR)
    for letter, colour in GROUND.items():
        picture[letters == letter] = shade(colour)
    matters = policy.matters.reshape(letters.shape)
    picture[matters] = colours(np.clip(scale(policy.values), 0, 1))[policy.matters, :3]
    # As a mesh, because an image would be resampled for every pixel.
    n_rows, n_columns = letters.shape
    axes.pcolormesh(np.arange(n_columns + 1) - 0.5, np.arange(n_rows + 1) - 0.5, picture)
    low = policy.matters & is_below(policy.values, scale)
    below = [Rectangle((x - 0.5, y - 0.5), 1, 1) for x, y in zip(*policy.places(low), strict=True)]
    axes.add_collection(PatchCollection(below, linewidth=0, **BELOW))


def is_below(values: Floats, scale: Normalize) -> Bools:
    """Which values lie below the scale by more than rounding."""
    return np.asarray(scale(values) < -1e-9)


def draw_marks(axes: Axes, policy: Policy, cell: float) -> None:
    """Draw goals, traps, prizes and starts, and lines between the cells."""
    letters = np.array(list("".join(policy.layout.rows_in(policy.layer))))
    if cell >= SMALLEST_GRID:
        style: Any = {"color": shade(WHITE), "linewidth": min(cell / 30, 1.0)}
        right, bottom = policy.layout.n_columns - 0.5, policy.layout.n_rows - 0.5
        axes.hlines(np.arange(0.5, bottom), -0.5, right, **style)
        axes.vlines(np.arange(0.5, right), -0.5, bottom, **style)
    for letter, (marker, size, colour) in MARKS.items():
        columns, rows = policy.places(letters == letter)
        # The mark of a prize leaves room for the action.
        aside = 0.32 if letter == PRIZE else 0.0
        style = {"s": (size * cell) ** 2, "edgecolor": BLACK, "linewidth": cell / 60}
        axes.scatter(columns + aside, rows - aside, marker=marker, color=shade(colour), **style)
    font: Any = {"fontsize": min(max(0.22 * cell, 4), 12), "fontweight": "bold"}
    for x, y in zip(*policy.places(letters == START), strict=True):
        axes.text(x - 0.39, y - 0.38, "S", va="top", color=BLACK, in_layout=False, **font)


def draw_arrows(axes: Axes, policy: Policy, width: float, with_numbers: bool) -> None:
    """Draw an arrow for each action, or a ring for staying; dark in visited cells."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Annulus

    moves = np.array(policy.layout.moves)
    lift, reach = (0.1, 0.25) if with_numbers else (0.0, 0.33)
    head: Any = {"headwidth": 4, "headlength": 4, "headaxislength": 3.6, "minlength": 0}
    head |= {"angles": "xy", "units": "xy", "scale_units": "xy"}
    for visited, weight, strength in ((False, 0.75, 0.45), (True, 1.0, 1.0)):
        shown = policy.matters & (policy.visited == visited)
        cells, actions = np.nonzero(policy.actions & shown[:, None])
        rows, columns = np.divmod(cells, policy.layout.n_columns)
        down, right = reach * moves[actions].T
        # A single arrow lies across its cell, several begin in the middle.
        back = np.where(policy.actions.sum(axis=1)[cells] == 1, 1, 0)
        style: Any = {"alpha": strength, "zorder": 3}
        axes.quiver(
            *(columns - back * right, rows - lift - back * down),
            *((1 + back) * right, (1 + back) * down),
            **{"width": weight * width, "color": BLACK, "scale": 1, **head, **style},
        )
        if (still := (moves[actions] == 0).all(axis=1)).any():
            centres = zip(columns[still], rows[still] - lift, strict=True)
            rings = [Annulus(centre, 0.12, weight * width) for centre in centres]
            axes.add_collection(PatchCollection(rings, facecolor=BLACK, linewidth=0, **style))


def draw_numbers(axes: Axes, policy: Policy, font: float, decimals: int) -> None:
    """Write the values, ``font`` points high; those from 10,000 on in thousands."""
    style: Any = {"fontsize": font, "ha": "center", "va": "center_baseline", "color": BLACK}
    values = policy.values[policy.matters]
    for x, y, value in zip(*policy.places(policy.matters), values, strict=True):
        digits = 0 if abs(value) >= 99.5 else decimals
        text = f"{value / 1e3:.0f}k" if abs(value) >= 9_999.5 else f"{value:z.{digits}f}"
        axes.text(x, y + 0.29, text.replace("-", "\N{MINUS SIGN}"), in_layout=False, **style)


def mark_differing(axes: Axes, policy: Policy, cell: float) -> None:
    """Draw a frame in the cells where the agent's action is not optimal."""
    from matplotlib.collections import LineCollection

    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * 0.44
    frames = list(np.stack(policy.places(policy.differs), axis=-1)[:, None] + corners)
    style: Any = {"color": ORANGE, "linewidth": min(max(cell / 16, 1.0), 2.4)}
    axes.add_collection(LineCollection(frames, joinstyle="miter", zorder=4, **style))


# --- whole pictures: two maps side by side --------------------------------------------------------

# Pale enough for dark arrows and numbers; darker means better, also in print and without colours.
VALUE_COLOURS = ("#FFFBD6", "#D3ECC0", "#8FD0C0", "#55B0CC", "#4A97CF")
COST_COLOURS = ("#FFFFFF", "#FBD9B5", "#F2994A", "#C8501E")
MAX_LAYERS = 4
VALUES = "expected return from here on"
LEAST_SHARE = 0.5  # per cent of the gap; cells with a lower cost stay empty
MAX_TICKS = 6
DIM = "#777777"
MARGIN = 1.3  # inches, for title, legend and colour bar


class Side(NamedTuple):
    """One of the two maps of a picture."""

    title: str
    shown: ValueMap
    is_best: bool  # whether it shows the optimal policies, not the agent's
    scale: Normalize
    colours: Colormap
    decimals: int


def draw_value_map(path: Path, title: str, found: ValueMap) -> None:
    """Draw a map into a PNG file; colours are exact values, scaled by the optimal ones."""
    agent = _agents_side(found)
    best = f"optimum, all best actions: return {_at_start(found, found.optimal_values)}"
    sides = agent, agent._replace(title=best, is_best=True)
    _draw(path, title, sides, {VALUES: agent})


def draw_cost_map(path: Path, title: str, found: ValueMap, losses: Floats) -> None:
    """Draw an agent's values and the losses of its actions into a PNG file.

    ``losses`` are those of each state, in return per episode, shape (S,).
    """
    shares = 100 * losses / max(float(losses.sum()), 1e-12)
    costs = replace(found, values=shares, matters=found.visited & (shares >= LEAST_SHARE))
    told = f"loss of its actions: {losses.sum():,.4g} in total"
    scale = 0.0, max(float(shares.max()), 1e-12)
    cost = Side(told, costs, False, *_scaled(scale, COST_COLOURS), 0)
    agent = _agents_side(found)
    bars = {VALUES: agent, "share of the gap, in per cent": cost}
    _draw(path, title, (agent, cost), bars)


def _agents_side(found: ValueMap) -> Side:
    best = found.optimal_values[found.matters]
    low, high = float(best.min()), float(best.max())
    colours = _scaled((low, high if high > low else low + 1), VALUE_COLOURS)
    title = f"agent: return {_at_start(found, found.values)}"
    return Side(title, found, False, *colours, decimals_for(found))


def _at_start(found: ValueMap, values: Floats) -> str:
    """The return from the start with four significant digits, as in the tables of a study."""
    value = float(found.initial @ values)
    text = f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _scaled(ends: tuple[float, float], names: tuple[str, ...]) -> tuple[Normalize, Colormap]:
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    return Normalize(*ends), LinearSegmentedColormap.from_list("", names)


def _draw(path: Path, title: str, sides: tuple[Side, Side], bars: dict[str, Side]) -> None:
    from matplotlib.cm import ScalarMappable

    found = sides[0].shown
    layout = found.layout
    # The layers that a policy reaches, those with the fewest prizes first.
    come_to = found.matters & (found.visited | found.optimal_visited)
    layers = np.unique(layout.layers[come_to]).tolist()
    layers = sorted(layers, key=lambda layer: (layer.bit_count(), layer))[:MAX_LAYERS]
    figure, pairs, cell = _panels(layout, len(layers))
    for axes, side in zip(pairs[0], sides, strict=True):
        axes.set_title(side.title, fontsize=10, loc="left")
    for pair, layer in zip(pairs, layers, strict=True):
        if layout.prizes:
            places = [layout.place_name(place) for place in layout.collected_in(layer)]
            collected = f"{layout.names.get(PRIZE, 'prize')} collected at {'; '.join(places)}"
            pair[0].set_ylabel(collected if places else "nothing collected")
    for (label, side), *own in zip(bars.items(), *pairs, strict=False):
        source = ScalarMappable(side.scale, side.colours)
        beside = own if len(bars) > 1 else figure.axes
        colour_bar = figure.colorbar(source, ax=beside, label=label, aspect=30, pad=0.02)
        colour_bar.ax.spines[:].set_visible(False)
    style: Any = {"fontsize": 9, "frameon": False, "loc": "outside lower left"}
    n_columns = int(np.clip(figure.get_figwidth() / 2.6, 1, 4))
    figure.legend(handles=list(_legend(found, sides[0].scale)), ncols=n_columns, **style)
    figure.suptitle(title, x=0.01, ha="left")
    fix_layout(figure)  # artists inside the panels need no margin
    for pair, layer in zip(pairs, layers, strict=True):
        for axes, side in zip(pair, sides, strict=True):
            policy = policy_in(side.shown, layer, side.is_best)
            draw_ground(axes, policy, side.scale, side.colours)
            draw_marks(axes, policy, cell)
            font = min(0.2 * cell, 9.0)
            width = min(2.9 / cell, 0.085) * (0.5 if side.is_best else 1)
            draw_arrows(axes, policy, width, with_numbers=font >= SMALLEST_FONT)
            if font >= SMALLEST_FONT:
                draw_numbers(axes, policy, font, side.decimals)
            mark_differing(axes, policy, cell)
    write_png(figure, path)


def decimals_for(found: ValueMap) -> int:
    """Decimals that distinguish the values: none for integers, three for shares of 1."""
    values = np.concatenate([found.values[found.matters], found.optimal_values[found.matters]])
    if np.abs(values - np.round(values)).max() < 1e-9:
        return 0
    best = found.optimal_values[found.matters]
    if np.abs(best).max() <= 1:
        return 3
    return 2 if np.ptp(best) < 10 else 1


def _panels(layout: GridLayout, n_layers: int) -> tuple[Figure, list[list[Axes]], float]:
    """Make a figure with two empty panels for each layer; also the width of a cell in points."""
    from matplotlib.figure import Figure

    longest = max(layout.n_rows, layout.n_columns)
    is_wide = layout.n_columns >= 2 * layout.n_rows  # panels are then stacked
    # In inches: small maps are readable, and large ones fit on a screen.
    cell = min(max(0.5 * longest, 3.2), 9.0 if is_wide else 7.0) / longest
    n_rows, n_columns = (2 * n_layers, 1) if is_wide else (n_layers, 2)
    width = n_columns * (cell * layout.n_columns + 0.3) + MARGIN
    height = n_rows * (cell * layout.n_rows + 0.35) + MARGIN
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False)
    right, bottom = layout.n_columns - 0.5, layout.n_rows - 0.5
    # Drawing labels takes more time than everything else.
    step = next(step for step in (1, 2, 5, 10, longest) if longest <= MAX_TICKS * step)
    for number, axes in enumerate(panels.flat):
        named = number % n_columns == 0
        axes.set(xlim=(-0.5, right), ylim=(bottom, -0.5), aspect="equal")
        # Rows and columns are counted from 1, as in all output.
        for axis, length in ((axes.xaxis, layout.n_columns), (axes.yaxis, layout.n_rows)):
            shown = range(step - 1, length if named or axis is axes.xaxis else 0, step)
            axis.set_ticks(shown, [str(place + 1) for place in shown])
        axes.tick_params(length=0, labelsize=7, labelcolor=DIM, pad=2)
        axes.spines[:].set_visible(False)
    return figure, panels.reshape(-1, 2).tolist(), 72 * cell


def _legend(found: ValueMap, scale: Normalize) -> Iterator[Artist]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    arrow: Any = {"color": BLACK, "marker": ">", "markersize": 6, "markeredgecolor": BLACK}
    yield Line2D([], [], linewidth=2, label="on the way from the start", **arrow)
    yield Line2D([], [], linewidth=1.5, alpha=0.45, label="elsewhere", **arrow)
    differs = f"not an optimal action ({found.differs.sum()} of {found.matters.sum()} states)"
    yield Patch(facecolor="none", edgecolor=ORANGE, linewidth=2, label=differs)
    if is_below(found.values[found.matters], scale).any():
        yield Patch(label="value below the scale", **BELOW)
    letters = set("".join(found.layout.rows))
    words = {GOAL: "goal", TRAP: "trap", WALL: "wall", PRIZE: "prize", **found.layout.names}
    if WALL in letters:
        yield Patch(color=shade(SHELF), label=words[WALL])
    for letter, (marker, size, colour) in MARKS.items():
        if letter in letters:
            style: Any = {"marker": marker, "markersize": 8 + 6 * size, "markeredgecolor": BLACK}
            yield Line2D([], [], color=shade(colour), linewidth=0, label=words[letter], **style)
