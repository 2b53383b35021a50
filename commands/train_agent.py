"""``train.py``: what it does."""

from __future__ import annotations

import argparse
from functools import partial
from typing import TYPE_CHECKING, Any

from commands.parsing import command_line, exit_code
from commands.streams import go_on_unread
from commands.train_flags import RESUMING, build_parser
from pipeline.foreign_exits import exits_as_mistakes
from pipeline.library_loading import loading_libraries
from pipeline.stopping import StopRequest, stops_noticed

if TYPE_CHECKING:
    from pipeline.train_spec import TrainSpec


def main() -> int:
    """Parse the arguments and do what they ask for; the exit code."""
    args = build_parser().parse_args()
    with stops_noticed() as stop, exits_as_mistakes():
        return _train(args, stop)


def _train(args: argparse.Namespace, stop: StopRequest) -> int:
    if args.list:
        return _list(args)
    if args.resume is not None:
        from commands.resume_training import resume_run

        return resume_run(args, stop)
    from commands.train_request import train_spec

    spec = train_spec(args)
    if args.resume_or_start:
        from commands.resume_training import resume_same

        code = resume_same(args, spec, stop)
        if code is not None:
            return code
    return _begin(args, spec, stop)


def _list(args: argparse.Namespace) -> int:
    from commands.listing import print_lists
    from pipeline.user_modules import import_typed

    import_typed(args.gym_packages)
    print_lists()
    return 0


def _begin(args: argparse.Namespace, spec: TrainSpec, stop: StopRequest) -> int:
    from commands.run_output import (
        print_engine,
        print_header,
        print_line,
        print_refusal,
        print_result,
        telling_what_is_kept,
        writing_watched,
    )
    from commands.terminal import TextConsole
    from pipeline.signs_of_life import doing

    go_on_unread()
    console = TextConsole(quiet=spec.verbose < 1, force_terminal=spec.progress or None)
    print_header(console, spec)
    # What is called here says for itself where it can be stopped; between its parts a stop would
    # leave a run folder that nobody works on.
    with stop.held():
        with doing(console, "loading the libraries") as activity, loading_libraries():
            with stop.waiting(0.0):
                from pipeline.run_folder import INTERRUPTED
                from pipeline.run_lock import at_work_on
                from pipeline.training import carry_out, prepare
                from pipeline.unfinished_runs import StateKeeping

            activity.now("making the environments and the agent")
            keeping = StateKeeping(args.save_state_every, stays=args.keep_state)
            training = prepare(spec, console, _recorded(args), command_line(), keeping=keeping)
            print_engine(console, training)
        print_refusal(console, training.refusal)
        with (
            at_work_on(training.run, partial(print_line, console)),
            telling_what_is_kept(training.run),
            writing_watched(console, training),
        ):
            outcome = carry_out(training, partial(print_result, console, training))
    return exit_code(stop.number) if outcome.state == INTERRUPTED else 0


def _recorded(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments as a run folder keeps them; what goes on is no matter of the run's."""
    return {name: value for name, value in vars(args).items() if name not in RESUMING}
