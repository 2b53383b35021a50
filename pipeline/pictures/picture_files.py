"""Figures with a constrained layout, written as PNG and drawn once."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def fix_layout(figure: Figure) -> None:
    """Work the layout out now, by what is there: what is drawn later gets no room of its own."""
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine("none")


def write_png(figure: Figure, path: Path) -> None:
    """Draw a figure, whose layout is fixed, into a file.

    `Figure.savefig` would draw everything twice, the first time for the layout.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    with replacing(path) as file:
        canvas.print_png(file)
