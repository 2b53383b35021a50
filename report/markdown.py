"""Text and tables as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence

from pipeline.errors import visible
from report.markup_language import MarkupLanguage

PLAIN_NAME = re.compile(r"[\w.=+-]+")
# What would be read as markup: not underscores inside words, nor brackets that are no link.
_MARKUP = re.compile(r"[\\`*<>|~&]|(?<!\w)_|_(?!\w)|\](?=[(\[:])|^[#+-]")


def markdown_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], caption: str = ""
) -> str:
    """Lines of a table, and the caption below; all Markdown already, with no line breaks."""
    lines = [headings, ["---"] * len(headings), *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"{table}\n\n{caption}" if caption else table


def name_of(label: str) -> str:
    """A label as code where it is a plain name, else as text."""
    return f"`{label}`" if PLAIN_NAME.fullmatch(label) else escaped(label)


def escaped(text: str) -> str:
    """Text in which nothing is markup."""
    return _MARKUP.sub(lambda found: "\\" + found[0], " ".join(visible(text).split()))


MARKDOWN = MarkupLanguage(
    preamble=lambda _: "",
    title=lambda text: f"# {escaped(text)}",
    heading=lambda text: f"## {escaped(text)}",
    command=lambda text: f"`{visible(text).replace('`', ' ')}`",
    text=escaped,
    items=lambda texts: "\n".join(f"- {escaped(text)}" for text in texts),
    name=name_of,
    figure=str,
    bold=lambda text: f"**{text}**",
    table=markdown_table,
)
