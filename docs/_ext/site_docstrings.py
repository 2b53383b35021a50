"""Converts headings, lists and tables in docstrings from Markdown to reStructuredText."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx


def mend(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Turn ``## Heading`` into a rubric, tables into literal text; put empty lines before lists."""
    mended: list[str] = []
    for line in lines:
        if line.startswith("| ") and not (mended and mended[-1].startswith("    |")):
            mended += ["::", ""]  # a Markdown table becomes literal text
        if line.startswith(("| ", "|--")):
            mended.append(f"    {line}")
            continue
        heading = re.match(r"##+ (.*)", line)
        starts_list = line.startswith("- ") and mended and mended[-1][:2] not in ("- ", "  ", "")
        if starts_list:
            mended.append("")
        mended += ["", f".. rubric:: {heading[1]}", ""] if heading else [line]
    lines[:] = mended


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", mend)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
