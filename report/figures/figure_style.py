"""The look of a study's figures, and how one becomes files: PNG and SVG."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.figure import Figure

from pipeline.files import replacing
from report.series.agent_marks import COLOURS, Dash, Mark

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What Matplotlib calls Plotly's line styles.
_LINE_STYLES: Mapping[Dash, str] = {"solid": "-", "dash": "--", "dashdot": "-.", "dot": ":"}

REFERENCE = "0.35"  # the grey of lines that are no agent's

_FONTS: Any = {"font.size": 10, "axes.titlesize": 11, "legend.fontsize": 9, "svg.fonttype": "none"}


def line_style(mark: Mark) -> dict[str, Any]:
    """Colour and line style of an agent, as Matplotlib's functions take them."""
    return {"color": COLOURS[mark.colour], "linestyle": _LINE_STYLES[mark.dash]}


def colour_of(mark: Mark) -> str:
    """The colour alone."""
    return COLOURS[mark.colour]


@contextmanager
def figure(
    path: Path, written: list[Path], n_columns: int = 1, height: float = 4.2, n_rows: int = 1
) -> Iterator[Sequence[Axes]]:
    """Axes row by row, written to ``path`` as .png and .svg in the end."""
    with mpl.rc_context(_FONTS):
        canvas = Figure(figsize=(6.4 * n_columns, height), layout="constrained")
        axes = list(canvas.subplots(n_rows, n_columns, squeeze=False).flat)
        yield axes
        for place in axes:
            place.grid(alpha=0.3)
            place.spines[["top", "right"]].set_visible(False)
        for suffix, options in ((".png", {"dpi": 150}), (".svg", {"metadata": {"Date": None}})):
            target = path.with_name(path.name + suffix)
            with replacing(target) as file:
                canvas.savefig(file, format=suffix[1:], **options)
            written.append(target)
            # The second file looks as the first: finding places for all takes longest.
            canvas.set_layout_engine("none")


def shared_legend(axes: Axes) -> None:
    """Below the whole figure, the names of what these axes show."""
    handles, names = axes.get_legend_handles_labels()
    if handles:
        axes.figure.legend(
            handles, names, loc="outside lower center", ncols=min(len(names), 4), frameon=False
        )
