"""Turns documents at the root of the repository into pages, and adapts links to them.

A code host shows CONTRIBUTING.md and similar documents at the root, and pages in docs/ link there.
On the site, each is a page; its file in docs/ has one line, which refers to the document.
"""

from __future__ import annotations

import re
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "contributing": "CONTRIBUTING.md",
    "security": "SECURITY.md",
    "changelog": "CHANGELOG.md",
}


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the text of a document's page by the document, and adapt links to documents."""
    if page in PAGES:
        path = ROOT / PAGES[page]
        app.env.note_dependency(path, docname=page)
        source[0] = path.read_text(encoding="utf-8").replace("](docs/", "](")
    up = "../" * page.count("/")
    for name, file in PAGES.items():
        link = rf"\]\((?:\.\./)*{re.escape(file)}(#[\w-]+)?\)"
        source[0] = re.sub(link, rf"]({up}{name}.md\1)", source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
