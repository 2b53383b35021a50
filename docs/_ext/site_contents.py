"""Adds tables of contents to pages on the site only: a code host would show them as code."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

# First pages of folders, and the prefix of the names of the other pages there. Pages to which the
# first page links come first, in the order of the links.
FOLDERS = {
    "algorithms": "algorithms/",
    "environments": "environments/",
    "lessons/index": "0",
}
# The placeholder in index.md for the pages that index.md does not name.
REST = "every-other-page"


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the list of pages to the first page of a folder, and all other pages to the index."""
    if page in FOLDERS:
        linked = re.findall(rf"\]\(({FOLDERS[page]}[\w-]+)\.md", source[0])
        above = page.rpartition("/")[0]
        start = f"{above}/" * bool(above)
        inside = [name.removeprefix(start) for name in app.env.found_docs if name.startswith(start)]
        others = sorted(name for name in inside if name.startswith(FOLDERS[page]))
        names = "\n".join(dict.fromkeys([*linked, *others]))
        source[0] += f"\n```{{toctree}}\n:hidden:\n{names}\n```\n"
    if page == "index":
        named = set(source[0].split())
        found = {name for name in app.env.found_docs if "/" not in name} - {"index"}
        source[0] = source[0].replace(REST, "\n".join(sorted(found - named)))


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
