"""Where the commands print to."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from pipeline.errors import visible

WIDTH_WITHOUT_TERMINAL = 120


class TextConsole(Console):
    """A console that shows what control characters there are in a text, and obeys none of them.

    Labels, titles and names come from files; what moves the cursor or sets a colour is Rich's own.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        """As Rich does, of the text made visible, so that it is measured as it is shown."""
        return super().render_str(visible(text), **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """As Rich does, the text of every segment made visible, whatever it comes from."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            yield segment if control else Segment(visible(text), style)


def table_console(*, highlight: bool = True) -> Console:
    """A console that is wide enough for tables where no terminal says how wide it is."""
    console = TextConsole(highlight=highlight)
    if console.is_terminal:
        return console
    return TextConsole(highlight=highlight, width=WIDTH_WITHOUT_TERMINAL)
