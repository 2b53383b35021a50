"""The look of a study's figures, and how one becomes files.

A figure is as wide as the text of a page, so that it is printed as it is drawn. Words that would be
wider than what they belong to go over several lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Patch
from matplotlib.textpath import TextToPath

from pipeline.files import replacing
from report.series.agent_marks import COLOURS, Dash, Mark

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What Matplotlib calls Plotly's line styles.
_LINE_STYLES: Mapping[Dash, str] = {"solid": "-", "dash": "--", "dashdot": "-.", "dot": ":"}

REFERENCE = "0.35"  # the grey of lines that are no agent's
MOST_BANDS = 4  # of one figure: more lie over each other until none can be told apart

# Inches.
WIDTH, HEIGHT = 6.5, 2.7  # of a row of panels
_BESIDE, _BELOW = 0.85, 0.8  # what numbers and words take of a panel
_END = 1.5  # of the names beside the ends of lines
_LINE = 0.14  # from one line of small print to the next

_SMALL, _PLAIN, _TITLE = 8, 9, 9.5
_FONTS: Any = {
    "font.size": _PLAIN,
    "axes.titlesize": _TITLE,
    "axes.labelsize": _PLAIN,
    "xtick.labelsize": _SMALL,
    "ytick.labelsize": _SMALL,
    "legend.fontsize": _SMALL,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,  # what publishers take
}
FORMATS = ("png", "svg", "pdf")

LOG = "(log scale)"


def line_style(mark: Mark) -> dict[str, Any]:
    """Colour and line style of an agent, as Matplotlib's functions take them."""
    return {"color": COLOURS[mark.colour], "linestyle": _LINE_STYLES[mark.dash]}


def colour_of(mark: Mark) -> str:
    """The colour alone."""
    return COLOURS[mark.colour]


@dataclass(frozen=True)
class FigureFiles:
    """The files that figures become.

    Attributes:
        folder: where.
        formats: which: "png", "svg", "pdf".
        written: those that there are by now.
    """

    folder: Path
    formats: Sequence[str] = FORMATS[:2]
    written: list[Path] = field(default_factory=list)

    @contextmanager
    def figure(
        self, name: str, n_columns: int = 1, n_rows: int = 1, height: float = HEIGHT
    ) -> Iterator[Sequence[Axes]]:
        """Axes row by row, ``height`` inches each, written under that name in the end."""
        with mpl.rc_context(_FONTS):
            # The resolution is that of the PNG; the other formats have none.
            canvas = Figure(figsize=(WIDTH, height * n_rows), dpi=300, layout="constrained")
            axes = list(canvas.subplots(n_rows, n_columns, squeeze=False).flat)
            for place in axes:
                place.grid(alpha=0.3)
                place.spines[["top", "right"]].set_visible(False)
            yield axes
            for form in sorted(set(self.formats), key=FORMATS.index):
                self.written.append(self.folder / f"{name}.{form}")
                with replacing(self.written[-1]) as file:
                    write(canvas, form, file)
                # The other files look as the first: finding places for all takes longest.
                canvas.set_layout_engine("none")


def write(canvas: Figure, form: str, file: BinaryIO) -> None:
    """Write a figure by its backend; `savefig` would draw twice, the first time for places."""
    backend = import_module(f"matplotlib.backends.backend_{'agg' if form == 'png' else form}")
    undated = {"svg": {"metadata": {"Date": None}}, "pdf": {"metadata": {"CreationDate": None}}}
    getattr(backend.FigureCanvas(canvas), f"print_{form}")(file, **undated.get(form, {}))


def width_of(text: str, size: float = _SMALL) -> float:
    """The width of a line in inches."""
    font = FontProperties(size=size)
    return TextToPath().get_text_width_height_descent(text, font, ismath=False)[0] / 72


def wrapped(text: str, width: float, size: float = _SMALL) -> str:
    """The text in lines of at most ``width`` inches; a dollar sign in it begins no formula."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".lstrip()
        if width_of(longer, size) <= width:
            lines[-1] = longer
            continue
        lines += [""] if lines[-1] else []
        for letter in word:
            if lines[-1] and width_of(lines[-1] + letter, size) > width:
                lines.append("")
            lines[-1] += letter
    return "\n".join(lines).replace("$", r"\$")


def lettering(
    axes: Axes, *, title: str = "", x: str = "", y: str = "", beside: float = _BESIDE
) -> None:
    """Title and names of the axes; ``beside`` is what stands left of the axes, in inches."""
    figure, spec = _figure_of(axes), axes.get_subplotspec()
    n_rows, n_columns = (1, 1) if spec is None else spec.get_gridspec().get_geometry()
    y = wrapped(y, max(figure.get_figheight() / n_rows - _BELOW, 1.0), _PLAIN)
    beside += 0.17 * y.count("\n")
    width = max(figure.get_figwidth() / n_columns - beside, 1.0)
    axes.set_title(wrapped(title, width, _TITLE), loc="left")
    axes.set_xlabel(wrapped(x, width, _PLAIN))
    axes.set_ylabel(y)


def _figure_of(axes: Axes) -> Figure:
    found = axes.get_figure(root=True)
    assert found is not None
    return found


def band_words(n_curves: int) -> str:
    """What the bands of so many curves are."""
    return (
        "95 % interval" if n_curves <= MOST_BANDS else f"95 % interval, of the first {MOST_BANDS}"
    )


def shared_legend(*places: Axes, band: str = "") -> None:
    """Below the whole figure, which becomes higher by it, the names of what the axes show."""
    named = [axes.get_legend_handles_labels() for axes in places]
    found = {name: handle for some in named for handle, name in zip(*some, strict=True)}
    if not found:
        return
    figure = _figure_of(places[0])
    found |= {band: Patch(color=REFERENCE, alpha=0.2, linewidth=0)} if band else {}
    names = [wrapped(name, figure.get_figwidth() / 2 - 0.8) for name in found]
    lines = [name.split("\n") for name in names]
    widest = max(width_of(line, _SMALL) for name in lines for line in name) + 0.65
    n_columns = min(len(names), max(int((figure.get_figwidth() - 0.3) / widest), 1))
    n_rows = -(-len(names) // n_columns) * max(map(len, lines))
    figure.set_figheight(figure.get_figheight() + _LINE * (n_rows + 1))
    handles = list(found.values())
    style = {"ncols": n_columns, "frameon": False, "handlelength": 2.5}  # as long as a dash and dot
    figure.legend(handles, names, loc="outside lower center", **style)


def make_room(axes: Axes, names: Sequence[str]) -> None:
    """Make a figure of one panel as high as the names beside its axes need."""
    lines = max(name.count("\n") + 1 for name in names)
    _figure_of(axes).set_figheight(1.1 + len(names) * max(0.32, _LINE * lines + 0.04))


def label_ends(axes: Axes, ends: Sequence[tuple[str, float, float, str]]) -> None:
    """Names beside the ends of lines; an arrow stands after one whose line has left the axes.

    Args:
        axes: where all lines have been drawn.
        ends: name, x, y and colour of each.
    """
    low, high = axes.get_ylim()
    names = [wrapped(f"{name} ↑" if y > high else name, _END) for name, _, y, _ in ends]
    figure, spec = _figure_of(axes), axes.get_subplotspec()
    n_rows = 1 if spec is None else spec.get_gridspec().nrows
    needed = [_LINE * (name.count("\n") + 1) for name in names]
    inches = max(figure.get_figheight() / n_rows - _BELOW, sum(needed))
    figure.set_figheight(max(figure.get_figheight(), (inches + _BELOW) * n_rows))
    seen = [float(np.clip(y, low, high)) for _, _, y, _ in ends]
    heights = [(y - low) / ((high - low) or 1.0) for y in seen]
    places = _apart(heights, [inch / inches for inch in needed])
    for name, (_, x, _, colour), y, place in zip(names, ends, seen, places, strict=True):
        axes.annotate(
            name,
            (x, y),
            xytext=(1.04, place),
            textcoords="axes fraction",
            fontsize=_SMALL,
            color=colour,
            verticalalignment="center",
            linespacing=1.1,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "linewidth": 0.5 if y < high else 0,
                "shrinkA": 0,
                "shrinkB": 0,
                "relpos": (0, 0.5),
            },
        )


def _apart(wanted: Sequence[float], sizes: Sequence[float]) -> list[float]:
    """Middles between 0 and 1 near those wanted, so that no two of these sizes overlap."""

    def span(group: list[int]) -> tuple[float, float]:
        """Where the sizes of a group lie one on the other, near what all of them want."""
        total = sum(sizes[k] for k in group)
        middle = float(np.mean([wanted[k] for k in group]))
        bottom = min(max(middle - total / 2, 0.0), 1 - total)
        return bottom, bottom + total

    groups: list[list[int]] = []
    for k in sorted(range(len(wanted)), key=lambda k: wanted[k]):
        group = [k]
        while groups and span(groups[-1])[1] > span(group)[0]:
            group = groups.pop() + group
        groups.append(group)
    places = list(wanted)
    for group in groups:
        bottom = span(group)[0]
        for k in group:
            places[k] = bottom + sizes[k] / 2
            bottom += sizes[k]
    return places
