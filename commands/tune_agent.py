"""``tune.py``: what it does."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from commands.parsing import command_line
from commands.places import Place, place_of
from commands.streams import go_on_unread
from commands.tune_flags import build_parser
from commands.tune_how import How
from pipeline.foreign_exits import exits_as_mistakes
from pipeline.signs_of_life import doing
from pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from rich.console import Console

    from tuning.tuning_spec import TuningSpec


def main() -> int:
    """Parse the arguments and do what they ask for; the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        return _tune(args)


def _tune(args: argparse.Namespace) -> int:
    from commands.tune_request import tuning_spec

    tuning = tuning_spec(args)
    from commands.terminal import table_console
    from experiments.fork_server import end_server

    go_on_unread()
    console = table_console()
    console.print(tuning.study.title, style="bold", highlight=False)
    root = Path(args.log_folder) / tuning.study.name
    try:
        how = _how(args, tuning, root, console)
        with doing(console, "loading the libraries"):
            from experiments.study_plan import plan

            how.place(root).get_ready(plan(replace(tuning.study, n_seeds=1), root))
            from commands.tune_driving import drive
            from pipeline.folder_lock import told_if_gone
            from tuning.searching import open_tuning
            from tuning.trial_storage import failing_in_a_line

            with failing_in_a_line(args.storage):
                opened = open_tuning(tuning, root, args.storage)
        with told_if_gone(root), failing_in_a_line(args.storage):
            return drive(console, opened, how)
    except KeyboardInterrupt:
        end_server()
        raise


def _how(args: argparse.Namespace, tuning: TuningSpec, root: Path, console: Console) -> How:
    from experiments.run_limits import RunLimits
    from tuning.trial_storage import without_secret

    # Every run folder notes the command, which is no place for a password.
    command = without_secret(command_line())
    limits = RunLimits(tuning.study.run_timeout, tuning.study.run_memory)
    say = partial(console.print, highlight=False, soft_wrap=True)

    @cache
    def place(folder: Path) -> Place:
        return place_of(args, folder, command, limits, say)

    place(root)  # so that a mistake in its flags is found at once
    return How(
        place=place,
        command=command,
        deadline=math.inf if args.timeout is None else time.monotonic() + args.timeout,
        with_page=not args.no_report,
    )
