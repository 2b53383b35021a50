"""``tune.py``: what it does."""

from __future__ import annotations

import argparse
import math
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from commands.parsing import command_line
from commands.streams import go_on_unread
from commands.tune_flags import build_parser
from pipeline.foreign_exits import exits_as_mistakes
from pipeline.signs_of_life import doing
from pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from experiments.launching import Launchers
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
    from experiments.child_processes import end_server, start_server

    go_on_unread()
    console = table_console()
    console.print(tuning.study.title, style="bold", markup=False, highlight=False)
    root = Path(args.log_folder) / tuning.study.name
    try:
        with doing(console, "loading the libraries"):
            start_server()
            import commands.tune_driving as driving
            from tuning.opening import open_tuning

            place = open_tuning(tuning, root, args.storage)
        deadline = math.inf if args.timeout is None else time.monotonic() + args.timeout
        how = driving.How(
            launchers=partial(_launchers, args, tuning),
            where=f"{_n_workers(args)} at once",
            command=_command(),
            deadline=deadline,
            with_page=not args.no_report,
        )
        return driving.drive(console, place, how)
    except KeyboardInterrupt:
        end_server()
        raise


def _launchers(args: argparse.Namespace, tuning: TuningSpec, root: Path) -> Launchers:
    """Where the runs in a folder are done."""
    from experiments.launching import local_launcher
    from experiments.run_limits import RunLimits

    limits = RunLimits(tuning.study.run_timeout, tuning.study.run_memory)
    return partial(local_launcher, root, _command(), _n_workers(args), limits)


def _command() -> str:
    """The command as every run folder notes it, which is no place for a password."""
    from tuning.trial_storage import without_secret

    return without_secret(command_line())


def _n_workers(args: argparse.Namespace) -> int:
    from experiments.launching import available_cores

    return max(args.jobs, 0) or available_cores()
