"""Fills what pages say of code, environments and agents: ``python docs/scripts/fill_pages.py``.

What stands between a pair of comments is replaced, so that nothing of it is typed, and pages can be
read on a code host too::

    <!-- code: agents/tabular/one_step.py best_next_value QLearning -->
    <!-- end -->

There are blocks of these kinds: ``code``, with a file and names in it; ``environment``, with an id
and arguments, for the picture, the facts and the docstring; ``facts``, likewise, without the
docstring; ``docstring``, with an id, for that alone; ``optima`` and ``variants``, with several ids,
for tables of optima; ``agents`` and ``agents-by-spaces``, with nothing. Commands that train say in
a comment what they reach, see docs/documented-commands.md. With ``--check`` nothing is written, and
it fails where a page is not as it should be.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(DOCS.parent), str(DOCS / "scripts")]

from agent_tables import agents_block, by_spaces_block  # noqa: E402
from code_blocks import code_block  # noqa: E402
from environment_facts import (  # noqa: E402
    docstring_block,
    environment_block,
    facts_block,
    optima_block,
    variants_block,
)
from recommended_commands import with_outcomes  # noqa: E402

BLOCK = re.compile(r"(<!-- ([\w-]+)(?:: ([^\n]*?))? -->\n)(.*?)(<!-- end -->)", re.DOTALL)
KINDS: dict[str, Callable[..., str]] = {
    "agents": agents_block,
    "agents-by-spaces": by_spaces_block,
    "code": code_block,
    "docstring": docstring_block,
    "environment": environment_block,
    "facts": facts_block,
    "optima": optima_block,
    "variants": variants_block,
}


def main() -> None:
    """Fill or check all pages."""
    parser = argparse.ArgumentParser(description="Fill what pages say of code and environments.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where it is old")
    check = parser.parse_args().check
    old = [path for path in sorted(DOCS.rglob("*.md")) if not is_current(path, write=not check)]
    for path in old:
        print(f"{path.relative_to(DOCS.parent)} {'is old' if check else 'is filled anew'}")
    if check and old:
        sys.exit("run: python docs/scripts/fill_pages.py")


def is_current(path: Path, *, write: bool = False) -> bool:
    """Whether a page is as it should be; otherwise write it, if that is asked for."""
    text = path.read_text(encoding="utf-8")
    new = filled(text)
    if write and new != text:
        path.write_text(new, encoding="utf-8")
    return new == text


def filled(text: str) -> str:
    """A page with all its blocks filled; blocks of other kinds stay as they are."""

    def fill(block: re.Match[str]) -> str:
        head, kind, arguments, _, end = block.groups()
        if kind not in KINDS:
            return block[0]
        return f"{head}{KINDS[kind](*(arguments or '').split())}{end}"

    return with_outcomes(BLOCK.sub(fill, text))


def pictured_environments() -> dict[str, dict[str, object]]:
    """The environments that pages show, with their arguments."""
    from pipeline.settings.values import parse_assignments

    found = {}
    for path in sorted(DOCS.rglob("*.md")):
        for _, kind, arguments, _, _ in BLOCK.findall(path.read_text(encoding="utf-8")):
            if kind in ("environment", "facts"):
                env_id, *pairs = arguments.split()
                found[env_id] = parse_assignments(pairs)
    return found


if __name__ == "__main__":
    main()
