"""Inserts text from the code into the site's pages: source code, docstrings, flags.

A page requests a block by a link with a title, which a code host shows as a link::

    [The code](../../rl_yardstick/agents/tabular/dyna.py "code: DynaQ")

The kinds of blocks: ``code``, with names that the linked file defines; ``docstring``, with the id
of an environment; ``flags``, with the name of a command; ``reference``, with a module and optional
names in it, for their docstrings below a heading. Tables stand in the pages themselves: see
docs/scripts/fill_tables.py.
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

from code_blocks import code_block  # noqa: E402
from environment_facts import docstring_block  # noqa: E402


def reference_block(module: str, *names: str) -> str:
    """A heading and the docstrings of a module, or of some names in it."""
    members = f":members: {', '.join(names)}".rstrip()
    return f"## `{module}`\n\n```{{eval-rst}}\n.. automodule:: {module}\n   {members}\n```"


KINDS: dict[str, Callable[..., str]] = {
    "code": code_block,
    "docstring": docstring_block,
    "flags": flags_block,
    "reference": reference_block,
}
LINE = re.compile(rf'^\[[^\]\n]*\]\((\S+) "({"|".join(KINDS)})(?:: ([^"\n]*))?"\)$', re.MULTILINE)


def filled(text: str, folder: Path) -> str:
    """The text of a page in ``folder``, with its requests replaced by the generated blocks."""

    def fill(line: re.Match[str]) -> str:
        target, kind, arguments = line.groups()
        words = (arguments or "").split()
        if kind == "code":
            words = [(folder / target).resolve().relative_to(DOCS.parent).as_posix(), *words]
        return KINDS[kind](*words).rstrip("\n")

    return LINE.sub(fill, text)


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Fill a page before it is parsed."""
    source[0] = filled(source[0], (DOCS / page).parent)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
