"""``yardstick --help`` and ``--version``, and the error for an unknown command."""

from __future__ import annotations

import sys

from rl_yardstick.commands import COMMANDS, NAME
from rl_yardstick.commands.cli import OneLineParser
from rl_yardstick.pipeline.errors import UserError, unknown


def main() -> int:
    """Print the help or the version; refuse what is no command."""
    from importlib.metadata import version

    lines = [f"  {NAME} {command:<9}{summary}" for command, summary in COMMANDS.items()]
    parser = OneLineParser(
        prog=NAME,
        usage=f"{NAME} [-h] [--version] COMMAND ...",
        description="Tabular, bandit and deep reinforcement learning, measured by the optimum.",
        epilog="\n".join(["commands:", *lines, "", f"Each has its own help: {NAME} train --help"]),
    )
    parser.add_argument("--version", action="version", version=version("rl-yardstick"))
    parser.add_argument("command", nargs="?", metavar="COMMAND", help=" or ".join(COMMANDS))
    given = parser.parse_args(sys.argv[1:2]).command
    if given is None:
        raise UserError(f"which command? {', '.join(COMMANDS)}")
    raise unknown("unknown command", given, COMMANDS)
