"""``train --resume`` and ``--resume-or-start``: going on with a run that was cut off."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from commands.parsing import command_line, exit_code
from commands.streams import go_on_unread
from commands.train_flags import build_parser
from pipeline.errors import UserError
from pipeline.run_files import remove_states
from pipeline.run_folder import Run
from pipeline.stopping import StopRequest, current
from pipeline.train_spec import TrainSpec
from pipeline.unfinished_runs import (
    go_on,
    is_finished,
    newest_unfinished,
    recorded_training,
    run_of_spec,
    tell_changes,
)

if TYPE_CHECKING:
    from rich.console import Console

    from pipeline.preparation import Training

# What may be given beside --resume: how it is shown, kept and imported, and not what is done.
_MAY_BE_GIVEN = (
    "resume",
    "save_state_every",
    "keep_state",
    "log_folder",
    "gym_packages",
    "verbose",
    "progress",
    "list",
)


def resume_run(args: argparse.Namespace, stop: StopRequest) -> int:
    """Go on with the run that the arguments name; the exit code.

    Raises:
        UserError: if there is none, it cannot go on, or another process is at work on it.
    """
    _check_given(args)
    from pipeline.models.recorded_runs import run_in
    from pipeline.user_modules import import_typed

    if args.resume:
        path = Path(args.resume)
        if not path.is_dir():
            raise UserError(f"{path}: there is no such run folder")
        run = run_in(path)
    else:
        run = newest_unfinished(Path(args.log_folder), args.algo, args.env)
    modules = import_typed(args.gym_packages)
    return _go_on(args, run, recorded_training(run, modules), stop)


def resume_same(args: argparse.Namespace, spec: TrainSpec, stop: StopRequest) -> int | None:
    """Go on with the newest run of the very same settings; the exit code, or None without one.

    Raises:
        UserError: if it cannot go on, or another process is at work on it.
    """
    run = run_of_spec(spec, any_seed=args.seed < 0)
    if run is None:
        return None
    return _go_on(args, run, recorded_training(run, spec.user_modules), stop)


def _check_given(args: argparse.Namespace) -> None:
    """Refuse what stands in the run folder already.

    Raises:
        UserError: naming the flag.
    """
    parser = build_parser()
    for action in parser._actions:
        action.default = argparse.SUPPRESS  # so that what is typed is there, also where it is that
    typed = vars(parser.parse_args())
    allowed = {*_MAY_BE_GIVEN, *(() if args.resume else ("algo", "env"))}
    for action in parser._actions:
        if action.dest in typed and action.dest not in allowed:
            flag = action.option_strings[-1]
            raise UserError(f"{flag} cannot be given with --resume: the run has its own")


def _go_on(args: argparse.Namespace, run: Run, spec: TrainSpec, stop: StopRequest) -> int:
    from commands.run_output import (
        print_engine,
        print_header,
        print_line,
        print_result,
        writing_watched,
    )
    from commands.terminal import TextConsole
    from pipeline.run_folder import INTERRUPTED
    from pipeline.run_lock import at_work_on, check_left

    spec = replace(spec, verbose=args.verbose, progress=args.progress)
    go_on_unread()
    console = TextConsole(quiet=spec.verbose < 1, force_terminal=spec.progress or None)
    if not is_finished(run):
        print_header(console, spec)
        check_left(run)
    with stop.held(), ExitStack() as lock:
        with stop.waiting(0.0):
            lock.enter_context(at_work_on(run, partial(print_line, console)))
        if is_finished(run):
            return _nothing_to_do(args, run, console)
        training = _prepared(args, run, spec, console)
        print_engine(console, training)
        from pipeline.training import carry_out

        with writing_watched(console, training):
            outcome = carry_out(training, partial(print_result, console, training))
    return exit_code(stop.number) if outcome.state == INTERRUPTED else 0


def _nothing_to_do(args: argparse.Namespace, run: Run, console: Console) -> int:
    if not args.keep_state:  # of a process that was killed just before it did that
        remove_states(run.state_path)
    console.print(f"{run.path} is finished already", highlight=False)
    return 0


def _prepared(args: argparse.Namespace, run: Run, spec: TrainSpec, console: Console) -> Training:
    """The run, to be carried out from its newest state on."""
    from commands.run_output import print_line
    from pipeline.library_loading import loading_libraries
    from pipeline.signs_of_life import doing
    from pipeline.unfinished_runs import StateKeeping

    say = partial(print_line, console)
    with doing(console, "loading the libraries") as activity, loading_libraries():
        with current().waiting(0.0):
            from pipeline.training import prepare

            activity.now("making the environments and the agent")
            tell_changes(run, spec, say)
            keeping = go_on(run, StateKeeping(args.save_state_every, stays=args.keep_state), say)
        page = spec.watch_learning
        if keeping.state is None and page is not None and not args.watch_learning and page.exists():
            say(f"{page} is there already and stays: nothing shows that this run wrote it")
            spec = replace(spec, watch_learning=None)
        if keeping.state is None:
            say("no state was saved: the run begins again")
        else:
            say(f"continuing from step {keeping.state.note['steps']:,}")
        return prepare(spec, console, {}, command_line(), run, keeping)
