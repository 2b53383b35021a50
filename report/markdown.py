"""Text and tables as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence

_PLAIN_NAME = re.compile(r"[\w.=+-]+")
# What would be read as markup: not underscores inside words, nor brackets that are no link.
_MARKUP = re.compile(r"[\\`*<>|~&]|(?<!\w)_|_(?!\w)|\](?=[(\[:])|^[#+-]")


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lines of a table; cells must be Markdown already, with no line breaks."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def name_of(label: str) -> str:
    """A label as code where it is a plain name, else as text."""
    return f"`{label}`" if _PLAIN_NAME.fullmatch(label) else escaped(label)


def escaped(text: str) -> str:
    """Text in which nothing is markup."""
    return _MARKUP.sub(lambda found: "\\" + found[0], " ".join(text.split()))
