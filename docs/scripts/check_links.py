"""Checks the links of a site: ``python docs/scripts/check_links.py build/site``.

Every link inside the site must lead to an existing file and, if it names one, to an existing
anchor. Pages must not load anything from elsewhere, so that the site works without a network.
"""

from __future__ import annotations

import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"img": "src", "script": "src", "link": "href", "iframe": "src"}
# Relations of <link> that browsers do not load.
TOLD = {"search", "index", "next", "prev", "canonical", "author", "help"}


class Page(HTMLParser):
    """The links, loaded files and anchors of a page.

    Attributes:
        links: targets of its links and of loaded files.
        loaded: targets that a browser fetches by itself.
        places: names of its anchors.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.places: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.places |= {given[name] for name in ("id", "name") if given.get(name)}
        target = given.get(LOADED.get(tag, "href"), "")
        if target:
            self.links.append(target)
            if tag in LOADED and given.get("rel") not in TOLD:
                self.loaded.append(target)


@cache
def page_at(path: Path) -> Page:
    """A page, read once."""
    return Page(path)


def faults(root: Path) -> list[str]:
    """The broken links and foreign files of a site, a line each."""
    found = []
    for path in sorted(root.rglob("*.html")):
        page = page_at(path)
        name = path.relative_to(root)
        found += [f"{name} loads {url}" for url in page.loaded if is_foreign(url)]
        inside = [url for url in page.links if not is_foreign(url)]
        found += [f"{name} links to {url}, {why}" for url in inside if (why := fault(path, url))]
    return found


def is_foreign(url: str) -> bool:
    """Whether a link leads out of the site; a data URI does not."""
    return bool(urlsplit(url).scheme or urlsplit(url).netloc) and not url.startswith("data:")


def fault(path: Path, url: str) -> str:
    """Why a link from a page is broken; empty if it is not."""
    if url.startswith("data:"):
        return ""
    parts = urlsplit(url)
    target = (path.parent / unquote(parts.path)) if parts.path else path
    if not target.is_file():
        return "which is not there"
    place = unquote(parts.fragment)
    if place and target.suffix == ".html" and place not in page_at(target.resolve()).places:
        return f"where there is no place {place}"
    return ""


def main() -> None:
    """Check the site in the folder that is given."""
    root = Path(sys.argv[1]).resolve()
    found = faults(root)
    n_pages = len(list(root.rglob("*.html")))
    if found or not n_pages:
        sys.exit("\n".join(found) or f"{root}: there are no pages")
    print(f"{n_pages} pages: all links lead somewhere, and nothing is loaded from elsewhere")


if __name__ == "__main__":
    main()
