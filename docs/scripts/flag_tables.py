"""Tables of the flags of a command, made from its parser."""

from __future__ import annotations

import argparse
import re
from importlib import import_module


def flags_block(command: str) -> str:
    """A row for each argument of a command, with what its help says."""
    parser: argparse.ArgumentParser = import_module(
        f"rl_yardstick.commands.{command.replace('-', '_')}"
    ).build_parser()
    lines = ["| argument | what it does |", "|---|---|"]
    for action in parser._actions:
        if action.dest == "help" or action.help == argparse.SUPPRESS:
            continue
        value = parser._get_formatter()._format_args(action, (action.dest or "").upper())
        names = action.option_strings or [""]
        typed = ", ".join(f"`{f'{name} {value}'.strip()}`" for name in names)
        told = parser._get_formatter()._expand_help(action) if action.help else ""
        told = re.sub(r"(?<![\w-])--?[a-z][a-z-]*", r"`\g<0>`", told)  # Sphinx joins dashes
        cells = (cell.replace("|", "\\|") for cell in (typed, told))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
