"""The look of a study's figures: one colour for each agent, PNG and SVG of each figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.study_spec import StudySpec
from pipeline.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, told apart by colour-blind readers too; the line styles go on where the
# colours begin again.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = ("-", "--", "-.", ":")

_FONTS: Any = {"font.size": 10, "axes.titlesize": 11, "legend.fontsize": 9, "svg.fonttype": "none"}


def agent_style(study: StudySpec, agent: str) -> dict[str, Any]:
    """Colour and line style of an agent, the same in every figure of a study."""
    place = [spec.label for spec in study.agents].index(agent)
    return {
        "color": COLOURS[place % len(COLOURS)],
        "linestyle": STYLES[place // len(COLOURS) % len(STYLES)],
    }


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
            with replacing(target) as draft:
                canvas.savefig(draft, format=suffix[1:], **options)
            written.append(target)
