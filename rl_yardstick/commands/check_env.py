"""``check-env``: what is wrong with an environment, found without training."""

from __future__ import annotations

import signal
import sys
import time

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, shared
from rl_yardstick.commands.terminal import table_console

EPILOG = """\
examples:
  python -m rl_yardstick check-env CartPole-v1
  python -m rl_yardstick check-env Warehouse-v0 --env-kwargs slip:0.1 --json found.json

Exit code: 0 if nothing breaks trainings, 1 if something does, 2 after a mistake in the command.
"""


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Check an environment for mistakes, within 20 seconds and without training."
    env = flag("env", "environment id, or a class: module:Class or file.py:Class", metavar="ID")
    others = shared("--env-kwargs", "--gym-packages", "--json")
    return OneLineParser(words, EPILOG, {"": [env, *others]})


def main() -> int:
    """Print the findings; return 1 if one of them breaks trainings."""
    args, begin = build_parser().parse_args(), time.monotonic()
    cli.import_typed(args)
    from rl_yardstick.diagnosis.environment_checks import LATE, examine
    from rl_yardstick.pipeline.environments import make_env
    from rl_yardstick.pipeline.settings import parse_assignments

    kwargs = {**parse_assignments(args.env_kwargs, "--env-kwargs"), "disable_env_checker": True}
    if sys.platform != "win32":
        signal.signal(signal.SIGALRM, lambda *_: sys.exit(LATE))
        signal.alarm(max(17 - int(time.monotonic() - begin), 5))  # seconds; a call may hang
    try:
        found = examine(lambda: make_env(args.env, kwargs))
    finally:
        if sys.platform != "win32":
            signal.alarm(0)
    console, seconds = table_console(), time.monotonic() - begin
    for one in found:
        console.print(str(one), style="red" if one.level == "breaks" else None)
    console.print(f"{args.env}: {len(found) or 'nothing'} found in {seconds:.1f} s")
    data = {"env": args.env, "seconds": seconds, "findings": [vars(one) for one in found]}
    cli.write_result(args, data)
    return int(any(one.level == "breaks" for one in found))
