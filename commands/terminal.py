"""Where the commands print to."""

from __future__ import annotations

from rich.console import Console

WIDTH_WITHOUT_TERMINAL = 120


def table_console(*, highlight: bool = True) -> Console:
    """A console that is wide enough for tables where no terminal says how wide it is."""
    console = Console(highlight=highlight)
    if console.is_terminal:
        return console
    return Console(highlight=highlight, width=WIDTH_WITHOUT_TERMINAL)
