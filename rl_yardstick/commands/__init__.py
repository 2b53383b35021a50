"""The commands: flags, actions and output; ``main`` is the entry point of ``yardstick``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import NoReturn


def main() -> NoReturn:
    """``yardstick``: run the command that the first argument names, and exit with its code."""
    try:
        from rl_yardstick.commands.cli import COMMANDS, NAME, run_command
    except KeyboardInterrupt:  # before anything has begun
        raise SystemExit(130) from None

    command = sys.argv[1] if len(sys.argv) > 1 else ""
    if command not in COMMANDS:
        _explain()
    # From here on the command has the name that a script of its own would have.
    sys.argv = [f"{NAME} {command}", *sys.argv[2:]]
    run_command(partial(_carry_out, command))


def _carry_out(command: str) -> int:
    """Import the command's module only, and run its main function."""
    if command in ("pack", "inspect"):
        from rl_yardstick.commands import share

        return share.pack() if command == "pack" else share.inspect()
    main: Callable[[], int] = import_module(f"rl_yardstick.commands.{command}").main
    return main()


def _explain() -> NoReturn:
    """Print the help, the version, or an error message on the first argument."""
    from importlib.metadata import version

    from rl_yardstick.commands.cli import COMMANDS, NAME, OneLineParser
    from rl_yardstick.pipeline.errors import unknown

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
        parser.error(f"which command? {', '.join(COMMANDS)}")
    parser.error(str(unknown("unknown command", given, COMMANDS)))
