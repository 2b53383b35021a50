"""What stands below which page, put there on the site alone: a code host would show it as code."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

# Pages that begin a folder, and what the names of the pages in it begin with. Those that the page
# links to come first, in its order.
FOLDERS = {
    "algorithms": "algorithms/",
    "environments": "environments/",
    "decisions/README": "0",
    "lessons/index": "0",
}
# In index.md, the place of the pages that it does not name.
REST = "every-other-page"


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the list of pages to a page that begins a folder, and what is new to the first page."""
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
