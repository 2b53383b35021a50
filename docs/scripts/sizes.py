"""Counts lines and files against the limits in CONTRIBUTING.md: ``python docs/scripts/sizes.py``.

Of Markdown it counts words instead of lines. The limits are only in the table there under "Size". A
row names, in code marks, folders (whose Python files count) or patterns; the row "together" is the
sum of the rows above it. Only files under version control count. It fails if a limit is exceeded.
"""

from __future__ import annotations

import re
import subprocess
import sys
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "CONTRIBUTING.md"
HEADING = "## Size\n"
ROW = re.compile(r"^\| ([^|]+) \| ([\d,]+) \| ([\d,]*) ?\|$", re.MULTILINE)


class Limit(NamedTuple):
    """A row of the table; without patterns it is the sum of the rows before it."""

    name: str
    patterns: tuple[str, ...]
    lines: int
    files: int | None


class Size(NamedTuple):
    """The size of a part."""

    lines: int
    files: int


def main() -> int:
    """Print a table of all parts; 1 if one is too large."""
    lengths = lengths_of_files(ROOT)
    limits = read_limits(PAGE.read_text(encoding="utf-8"))
    sizes = sizes_of(limits, lengths)
    exceeded = 0
    print(f"{'':42}{'lines':>8}{'limit':>8}{'':>7}{'files':>7}{'limit':>7}")
    for limit, size in zip(limits, sizes, strict=True):
        over = size.lines > limit.lines or (limit.files is not None and size.files > limit.files)
        exceeded += over
        print(
            f"{limit.name.replace('`', ''):42}{size.lines:8,}{limit.lines:8,}"
            f"{size.lines / limit.lines:7.0%}{size.files:7,}{limit.files or '':>7}"
            f"{'  too large' if over else ''}".rstrip()
        )
    counted = [pattern for limit in limits for pattern in limit.patterns]
    rest = [path for path in lengths if path.endswith(".py") and not matches(path, counted)]
    print(f"{'Python in no row':42}{sum(lengths[path] for path in rest):8,}{'':15}{len(rest):7,}")
    print(f"{exceeded} of {len(limits)} parts are too large")
    return int(exceeded > 0)


def lengths_of_files(root: Path) -> dict[str, int]:
    """Lines of each Python or TOML file and words of each Markdown file under version control."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "*.py", "*.md", "*.toml"],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    paths = [path for path in listing.stdout.split("\0") if (root / path).is_file()]
    contents = {path: (root / path).read_bytes() for path in paths}
    return {
        path: len(content.split() if path.endswith(".md") else content.splitlines())
        for path, content in contents.items()
    }


def read_limits(text: str) -> list[Limit]:
    """The table of limits of the contributors' page."""
    _, _, section = text.partition(HEADING)
    section, _, _ = section.partition("\n## ")
    rows = [Limit(*row) for row in map(_row, ROW.finditer(section))]
    if not rows:
        raise ValueError(f"there is no table under {HEADING.strip()!r} in {PAGE.name}")
    return rows


def _row(found: re.Match[str]) -> tuple[str, tuple[str, ...], int, int | None]:
    name, lines, files = found.groups()
    patterns = tuple(re.findall(r"`([^`]+)`", name))
    return name, patterns, int(lines.replace(",", "")), int(files.replace(",", "") or 0) or None


def sizes_of(limits: list[Limit], lengths: dict[str, int]) -> list[Size]:
    """The size of each part."""
    sizes: list[Size] = []
    for limit in limits:
        if limit.patterns:
            found = [length for path, length in lengths.items() if matches(path, limit.patterns)]
            sizes.append(Size(sum(found), len(found)))
        else:
            sizes.append(Size(sum(size.lines for size in sizes), sum(size.files for size in sizes)))
    return sizes


def matches(path: str, patterns: tuple[str, ...] | list[str]) -> bool:
    """Whether a file is in one of the folders (``mdp/``), or matches a pattern (``*.py``)."""
    for pattern in patterns:
        if pattern.endswith("/"):
            found = path.startswith(pattern) and path.endswith(".py")
        else:
            found = fnmatchcase(path, pattern) and ("/" in pattern or "/" not in path)
        if found:
            return True
    return False


if __name__ == "__main__":
    sys.exit(main())
