"""``check-env``: what is wrong with an environment, found without training."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, shared

EPILOG = """\
examples:
  python -m rl_yardstick check-env CartPole-v1
  python -m rl_yardstick check-env Warehouse-v0 --env-kwargs slip:0.1 --json findings.json

Exit code: 0 if nothing breaks trainings, 1 if something does, 2 after a mistake in the command.
"""
STYLES = {"breaks": "red", "bites": "yellow", "note": ""}


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Check an environment for mistakes, within 20 seconds and without training."
    flags = flag("env", "environment id", metavar="ID")
    common = shared("--env-kwargs", "--gym-packages", "--json")
    return OneLineParser(words, EPILOG, {"": [flags, *common]})


def main() -> int:
    """Print the findings; return 1 if one of them breaks trainings."""
    args = build_parser().parse_args()
    cli.import_typed(args)
    from rich.table import Table

    from rl_yardstick.commands.terminal import table_console
    from rl_yardstick.diagnosis.environment_checks import examine
    from rl_yardstick.pipeline.environments import make_env
    from rl_yardstick.pipeline.files import write_json
    from rl_yardstick.pipeline.settings import parse_assignments

    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # frames need no display
    console, begin = table_console(), time.monotonic()
    kwargs = {**parse_assignments(args.env_kwargs, "--env-kwargs"), "disable_env_checker": True}
    console.file = sys.stdout  # the checks redirect it
    make_env(args.env, kwargs).close()  # mistakes in the command end here
    with console.status("checking"):
        found = examine(lambda **extra: make_env(args.env, {**kwargs, **extra}))
    table = Table("level", "name", "what", "where", "how to mend")
    for one in found:
        cells = [one.level, one.name, one.what, one.where, one.mend]
        table.add_row(*cells, style=STYLES[one.level])
        if not console.is_terminal:
            where = f" ({one.where})" if one.where else ""
            console.print(f"{one.level:<6}  {one.name}: {one.what}{where}; {one.mend}")
    if console.is_terminal and found:
        console.print(table)
    seconds = time.monotonic() - begin
    told = f"{len(found)} finding{'s' * (len(found) != 1)}" if found else "nothing found"
    console.print(f"{args.env}: {told} in {seconds:.1f} s")
    if args.json is not None:
        found_data: list[dict[str, Any]] = [vars(one) for one in found]
        write_json(args.json, {"env": args.env, "seconds": seconds, "findings": found_data})
    return int(any(one.level == "breaks" for one in found))
