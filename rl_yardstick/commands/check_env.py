"""``check-env``: what is wrong with an environment, found without training."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, shared

if TYPE_CHECKING:
    from rl_yardstick.pipeline.environment_findings import Finding

EPILOG = """\
examples:
  python -m rl_yardstick check-env CartPole-v1
  python -m rl_yardstick check-env my/Corridor-v0 --gym-packages my_corridor

Exit code: 0 if nothing breaks trainings, 1 if something does, 2 after a mistake in the command.
"""
STYLES = {"breaks": "red", "bites": "yellow", "note": ""}


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Check an environment for mistakes, within 20 seconds and without training."
    flags = (
        flag("env", "environment id", metavar="ID"),
        *shared("--env-kwargs", "--gym-packages", "--json"),
    )
    return OneLineParser(words, EPILOG, {"": flags})


def main() -> int:
    """Print the findings; return 1 if one of them breaks trainings."""
    args = build_parser().parse_args()
    cli.import_typed(args)
    from rl_yardstick.commands.terminal import table_console
    from rl_yardstick.diagnosis.environment_checks import examine
    from rl_yardstick.pipeline.environments import make_env
    from rl_yardstick.pipeline.files import write_json
    from rl_yardstick.pipeline.settings import parse_assignments

    console = table_console()
    kwargs = parse_assignments(args.env_kwargs, "--env-kwargs")

    def make(**extra: Any) -> Any:
        return make_env(args.env, {**kwargs, **extra, "disable_env_checker": True})

    make().close()  # mistakes in the command end here
    begin = time.monotonic()
    with console.status("checking"):
        found = examine(make)
    seconds = time.monotonic() - begin
    if console.is_terminal and found:
        _print_table(console, found)
    for one in [] if console.is_terminal else found:
        where = f" ({one.where})" if one.where else ""
        console.print(f"{one.level:<6}  {one.name}: {one.what}{where}; {one.mend}")
    told = f"{len(found)} finding{'s' * (len(found) != 1)}" if found else "nothing found"
    console.print(f"{args.env}: {told} in {seconds:.1f} s")
    if args.json is not None:
        keys = ("level", "name", "what", "where", "mend")
        rows = [{key: getattr(one, key) for key in keys} for one in found]
        write_json(args.json, {"env": args.env, "seconds": seconds, "findings": rows})
    return int(any(one.level == "breaks" for one in found))


def _print_table(console: Any, found: list[Finding]) -> None:
    from rich.table import Table

    table = Table()
    table.add_column("level")
    for name in ("name", "what", "where", "how to mend"):
        table.add_column(name, overflow="fold")
    for one in found:
        cells = one.level, one.name, one.what, one.where, one.mend
        table.add_row(*cells, style=STYLES[one.level])
    console.print(table)
