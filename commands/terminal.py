"""Where the commands print to."""

from __future__ import annotations

from collections.abc import Iterable
from io import StringIO
from shutil import get_terminal_size
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from pipeline.errors import visible

UNBOUNDED = 10_000  # columns


class TextConsole(Console):
    """A console that shows what control characters there are in a text, and obeys none of them.

    Labels, titles and names come from files, so Rich's markup, which can crash or make links of
    them, is text too. What moves the cursor or sets a colour is Rich's own: see ``style``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """As Rich does; into a file or a pipe no line is broken, so that `grep` finds it whole."""
        if not self.is_terminal and all(isinstance(item, str) for item in objects):
            options.setdefault("soft_wrap", True)
        super().print(*objects, **options)

    def on_broken_pipe(self) -> None:
        """Leave it to `commands.streams`; Rich would keep silent from then on.

        Where a thread was told that says how far things are, the main thread would not learn of it.
        """
        raise BrokenPipeError

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
    """A console as wide as the terminal; of 80 columns, or `COLUMNS`, in a file or a pipe."""
    console = TextConsole(highlight=highlight)
    if console.is_terminal:
        return console
    return TextConsole(highlight=highlight, width=get_terminal_size().columns)


def print_rows(console: Console, table: Table) -> None:
    """Print a table without lines: into a file or a pipe each row as a line, however long."""
    if console.is_terminal:
        console.print(table, highlight=False)
        return
    wide = TextConsole(file=StringIO(), width=UNBOUNDED)
    wide.print(table, highlight=False)
    for line in wide.file.getvalue().splitlines():  # type: ignore[attr-defined]  # it is ours
        console.print(line.rstrip(), highlight=False, soft_wrap=True)
