"""The documents at the root of the repository as pages, and links to them from other pages.

A code host shows CONTRIBUTING.md and its like at the root, and pages in docs/ link there. On the
site each is a page, whose file in docs/ says in a line where its text is.
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
    """Put a document's text in the place of its page's, or mend a page's links to documents."""
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
