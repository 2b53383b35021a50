"""Adds tables of contents to pages on the site only: a code host would show them as code."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

# First pages of folders, and the prefix of the names of the other pages there. Pages to which the
# first page links come first, in the order of the links.
FOLDERS = {"algorithms": "algorithms/", "environments": "environments/", "lessons/index": "0"}
# Pages that the navigation shows below another.
BELOW = {
    "training": ["python", "run-folder", "watching", "masks", "model-files", "cluster"],
    "python": [
        f"notebooks/{one}" for one in ("quick-start", "my-agent-against-ppo", "rate-my-q-table")
    ],
    "compare": ["statistics", "library-vs-hand-rolled", "why-better"],
    "explain": ["critics", "audit", "shaping"],
    "environments": ["partial-observability"],
}


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the list of the pages below a page."""
    names = BELOW.get(page, [])
    if page in FOLDERS:
        linked = re.findall(rf"\]\(({FOLDERS[page]}[\w-]+)\.md", source[0])
        above = page.rpartition("/")[0]
        start = f"{above}/" * bool(above)
        inside = [name.removeprefix(start) for name in app.env.found_docs if name.startswith(start)]
        others = sorted(name for name in inside if name.startswith(FOLDERS[page]))
        names = list(dict.fromkeys([*linked, *others, *names]))
    if names:
        source[0] += "\n```{toctree}\n:hidden:\n" + "\n".join(names) + "\n```\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
