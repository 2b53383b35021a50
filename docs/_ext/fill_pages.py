"""Inserts blocks generated from code into pages: source code, facts on environments, tables.

A page requests a block by a link with a title, which a code host shows as a link::

    [The code](../../rl_yardstick/agents/tabular/dyna.py "code: DynaQ")

The kinds of blocks: ``code``, with names that the linked file defines; ``environment``, with an id
and arguments, for the picture, the facts and the docstring; ``facts`` and ``docstring``, with the
same arguments, for one part only; ``optima`` and ``variants``, with several ids, for tables of
optima; ``hardness``, with several ids, for a table of their hardness; ``agents`` and
``agents-by-spaces`` for tables of agents; ``flags``, with the name of a command; ``reference``,
with a module and optional names in it, for their docstrings below a heading; ``measured`` for a
linked file that a benchmark has published; ``timings``, the same for a file of
`benchmarks/timing.py`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(DOCS.parent), str(DOCS / "scripts")]

from flag_tables import flags_block  # noqa: E402

from agent_tables import agents_block, by_spaces_block  # noqa: E402
from code_blocks import code_block  # noqa: E402
from environment_facts import (  # noqa: E402
    docstring_block,
    environment_block,
    facts_block,
    hardness_block,
    optima_block,
    variants_block,
)
from measured_tables import measured_block, timings_block  # noqa: E402
from recommended_commands import with_outcomes  # noqa: E402


def reference_block(module: str, *names: str) -> str:
    """A heading and the docstrings of a module, or of some names in it."""
    members = f":members: {', '.join(names)}".rstrip()
    return f"## `{module}`\n\n```{{eval-rst}}\n.. automodule:: {module}\n   {members}\n```"


KINDS: dict[str, Callable[..., str]] = {
    "agents": agents_block,
    "agents-by-spaces": by_spaces_block,
    "code": code_block,
    "docstring": docstring_block,
    "environment": environment_block,
    "facts": facts_block,
    "flags": flags_block,
    "hardness": hardness_block,
    "measured": measured_block,
    "optima": optima_block,
    "reference": reference_block,
    "timings": timings_block,
    "variants": variants_block,
}
LINE = re.compile(rf'^\[[^\]\n]*\]\((\S+) "({"|".join(KINDS)})(?:: ([^"\n]*))?"\)$', re.MULTILINE)


def filled(text: str, folder: Path) -> str:
    """The text of a page in ``folder``, with its requests replaced by the generated blocks."""

    def fill(line: re.Match[str]) -> str:
        target, kind, arguments = line.groups()
        words = (arguments or "").split()
        if kind in ("code", "measured", "timings"):
            words = [(folder / target).resolve().relative_to(DOCS.parent).as_posix(), *words]
        return KINDS[kind](*words).rstrip("\n")

    return LINE.sub(fill, text)


def pictured_environments() -> dict[str, dict[str, object]]:
    """The environments that pages show, with their arguments."""
    from rl_yardstick.pipeline.settings import parse_assignments

    found = {}
    for path in sorted(DOCS.rglob("*.md")):
        for _, kind, arguments in LINE.findall(path.read_text(encoding="utf-8")):
            if kind in ("environment", "facts"):
                env_id, *pairs = arguments.split()
                found[env_id] = parse_assignments(pairs, env_id)
    return found


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Fill a page before it is parsed, also with the results of commands in docstrings."""
    source[0] = with_outcomes(filled(source[0], (DOCS / page).parent))


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
