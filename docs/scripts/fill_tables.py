"""Fills the generated tables of README and docs, between two comments, from code and measurements.

    python docs/scripts/fill_tables.py            # writes the pages anew
    python docs/scripts/fill_tables.py --check    # fails where a table is not up to date

A table stands between ``<!-- kind: arguments -->`` and ``<!-- end -->``. The kinds: ``facts``,
with an environment's id and arguments, for its picture and its figures; ``optima`` and
``variants``, with several ids, for their optima; ``hardness``, with several ids; ``agents`` and
``agents-by-spaces``; ``measured``, with a file of docs/measured that a benchmark has published;
``timings``, with a file of `benchmarks/timing.py`; ``output``, with a command in code marks, for
what it prints in an empty folder, which contains times and is not checked.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
sys.path[:0] = [str(ROOT), str(DOCS / "scripts")]

from agent_tables import agents_block, by_spaces_block  # noqa: E402
from environment_facts import (  # noqa: E402
    facts_block,
    hardness_block,
    optima_block,
    variants_block,
)
from measured_tables import measured_block, timings_block  # noqa: E402


def output_block(python: str, script: str, *words: str) -> str:
    """What a command of the checkout prints, as a block of text."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    with tempfile.TemporaryDirectory() as folder:
        for path in ROOT.glob("*.py"):
            (Path(folder) / path.name).symlink_to(path)
        done = subprocess.run(
            [sys.executable, script, *words],
            cwd=folder,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        )
    return f"```text\n{done.stdout.strip()}\n```\n"


KINDS: dict[str, Callable[..., str]] = {
    "agents": agents_block,
    "agents-by-spaces": by_spaces_block,
    "facts": facts_block,
    "hardness": hardness_block,
    "measured": measured_block,
    "optima": optima_block,
    "output": output_block,
    "timings": timings_block,
    "variants": variants_block,
}
BLOCK = re.compile(
    rf"<!-- (?P<kind>{'|'.join(KINDS)})(?:: (?P<arguments>.*?))? -->\n(?P<table>.*?)<!-- end -->",
    re.DOTALL,
)


def filled(text: str, *, outputs: bool = True) -> str:
    """The text of a page with its tables made anew; without ``outputs``, those stay."""

    def fill(block: re.Match[str]) -> str:
        if block["kind"] == "output" and not outputs:
            return block[0]
        made = KINDS[block["kind"]](*(block["arguments"] or "").strip("`").split())
        opening = block[0][: block.start("table") - block.start()]
        return f"{opening}{made.strip()}\n<!-- end -->"

    return BLOCK.sub(fill, text)


def pages() -> Iterator[Path]:
    """The pages that have a generated table."""
    for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md"))):
        if BLOCK.search(path.read_text(encoding="utf-8")):
            yield path


def requested(*kinds: str) -> list[list[str]]:
    """The arguments of all tables of some kinds."""
    blocks = (each for path in pages() for each in BLOCK.finditer(path.read_text(encoding="utf-8")))
    return [each["arguments"].split() for each in blocks if each["kind"] in kinds]


def main() -> None:
    """Fill or check all pages."""
    stale, checks = [], "--check" in sys.argv
    for path in pages():
        text = path.read_text(encoding="utf-8")
        if (new := filled(text, outputs=not checks)) != text:
            stale.append(path.relative_to(ROOT).as_posix())
            if not checks:
                path.write_text(new, encoding="utf-8")
                print(f"filled {stale[-1]}")
    if stale and checks:
        sys.exit(f"not up to date: {', '.join(stale)}; run python docs/scripts/fill_tables.py")


if __name__ == "__main__":
    main()
