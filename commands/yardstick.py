"""``yardstick``: all commands under one name, where the project is installed."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from typing import NoReturn

from commands.parsing import COMMANDS, NAME, OneLineParser, run_command
from pipeline.errors import unknown


def main() -> NoReturn:
    """Run the command that the first argument names, and exit with its code."""
    command = sys.argv[1] if len(sys.argv) > 1 else ""
    if command not in COMMANDS:
        _explain()
    # From here on it is as if the command had been called by a name of its own.
    sys.argv = [f"{NAME} {command}", *sys.argv[2:]]
    run_command(partial(_carry_out, command))


def _carry_out(command: str) -> int:
    """Do what the command does; the others' flags are not even looked at."""
    if command == "train":
        from commands import train_agent

        return train_agent.main()
    if command == "enjoy":
        from commands import enjoy_agent

        return enjoy_agent.main()
    if command == "inspect":
        from commands import inspect_model

        return inspect_model.main()
    if command == "pack":
        from commands import pack_run

        return pack_run.main()
    if command == "tune":
        from commands import tune_agent

        return tune_agent.main()
    from commands import compare_agents

    return compare_agents.main()


def _explain() -> NoReturn:
    """Print the help or the version, or what is wrong with the first argument."""
    from importlib.metadata import version

    parser = OneLineParser(
        prog=NAME,
        usage=f"{NAME} [-h] [--version] COMMAND ...",
        description="Tabular, bandit and deep reinforcement learning, measured by the optimum.",
        epilog=_epilog(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version("rl-yardstick"))
    parser.add_argument("command", nargs="?", metavar="COMMAND", help=" or ".join(COMMANDS))
    given = parser.parse_args(sys.argv[1:2]).command
    if given is None:
        parser.error(f"which command? {', '.join(COMMANDS)}")
    parser.error(str(unknown("unknown command", given, COMMANDS)))


def _epilog() -> str:
    lines = [f"  {NAME} {command:<9}{summary}" for command, summary in COMMANDS.items()]
    return "\n".join(["commands:", *lines, "", f"Each has its own help: {NAME} train --help"])
