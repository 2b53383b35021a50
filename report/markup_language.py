"""What a markup language has to be able to do so that a study can be written in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class MarkupLanguage:
    """How text becomes markup. All take plain text, but for ``table``, whose cells are markup.

    Attributes:
        preamble: what stands above all else, of the whole text below it.
        title, heading: of the whole, and of a part.
        command: a line for a terminal.
        text: a paragraph in which nothing is markup.
        items: a list of such texts.
        name: a label.
        figure: numbers and units.
        bold: such a figure, made to stand out.
        table: by headings, rows, and a caption; none has line breaks.
    """

    preamble: Callable[[str], str]
    title: Callable[[str], str]
    heading: Callable[[str], str]
    command: Callable[[str], str]
    text: Callable[[str], str]
    items: Callable[[Sequence[str]], str]
    name: Callable[[str], str]
    figure: Callable[[str], str]
    bold: Callable[[str], str]
    table: Callable[[Sequence[str], Sequence[Sequence[str]], str], str]
