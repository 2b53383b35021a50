"""Repeats stored runs to make their folders again, and moves damaged folders aside."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from rl_yardstick.commands.terminal import say
from rl_yardstick.pipeline.errors import UserError, unknown
from rl_yardstick.pipeline.files import put_in_place
from rl_yardstick.pipeline.signs_of_life import doing

if TYPE_CHECKING:
    from rich.console import Console

    from rl_yardstick.experiments.figures_store import FigureStore
    from rl_yardstick.experiments.launching import Launcher, RunFailure
    from rl_yardstick.experiments.plan import PlannedRun
    from rl_yardstick.experiments.results import LeftOut, StudyResults
    from rl_yardstick.experiments.study import StudySpec


class Context(Protocol):
    """The members of `commands.compare.RunContext` that this module uses."""

    root: Path
    console: Console
    store: FigureStore | None

    def get_ready(self, planned: Sequence[PlannedRun]) -> None:
        """Start the server that runs are forked from."""

    def launchers(self) -> AbstractContextManager[Launcher]:
        """Open a launcher of runs."""


def keep_few(
    context: Context, results: StudyResults
) -> tuple[StudyResults, list[RunFailure], bool]:
    """Make the folders of the few runs to keep; also failures, and whether no result differs."""
    from rl_yardstick.experiments.analysis import runs_to_keep

    if not results.stored:
        return results, [], True
    kept = [run for run in runs_to_keep(results) if not _otherwise(run).exists()]
    failures, is_same = _do_again(context, results.study, kept)
    there = tuple(run for run in kept if run.is_finished)
    return replace(results, kept=there), failures, is_same


def _do_again(
    context: Context, study: StudySpec, runs: Sequence[PlannedRun]
) -> tuple[list[RunFailure], bool]:
    """Make folders of stored runs again where they are missing or damaged.

    A run with another result than the first time is moved aside, with a message.
    """
    from rl_yardstick.experiments.launching import execute
    from rl_yardstick.experiments.results import read_run
    from rl_yardstick.experiments.run_folders import move_aside
    from rl_yardstick.pipeline.digests import DamagedFileError

    assert context.store is not None
    missing, is_same = [], True
    for run in runs:
        try:
            found = read_run(study, run)
        except DamagedFileError as error:
            found = None
            say(context.console, f"damaged: {error}; its folder is {move_aside(run.path).name} now")
        missing += [] if found else [run]
    if not missing:
        return [], True
    which = "1 run" if len(missing) == 1 else f"{len(missing)} runs"
    say(context.console, f"making the folders of {which} again")
    context.get_ready(missing)
    failures = execute(missing, context.root, context.launchers, lambda *_: None)
    for run in missing:
        if run.is_finished and not context.store.is_again(study, run):
            is_same, place = False, _otherwise(run)
            shutil.rmtree(place, ignore_errors=True)
            put_in_place(run.path, place)
            who = f"{run.agent} on {run.environment}, seed {run.seed}"
            words = "came out differently than the first time: another version or processor?"
            say(context.console, f"{who}: {words}; see {place}")
        elif run.is_finished:
            context.store.keep(run)
    return failures, is_same


def _otherwise(run: PlannedRun) -> Path:
    """The folder of a run whose repetition had another result."""
    return run.path.with_name(f"{run.path.name}.otherwise")


def make_again(context: Context, study: StudySpec, runs: Sequence[PlannedRun]) -> int:
    """Make the folders of stored runs again, bit for bit; return the exit code."""
    assert context.store is not None
    for run in runs:
        if not (context.store.holds(run) or run.is_finished):
            raise UserError(f"--make-again: {run.agent}:{run.seed} has not been done yet")
    failures, is_same = _do_again(context, study, [r for r in runs if context.store.holds(r)])
    for failure in failures:
        run = failure.planned
        say(context.console, f"failed: {run.agent}, seed {run.seed}: {failure.reason}")
    for run in runs:
        if run.is_finished:
            context.console.print(f"  {run.path}", highlight=False)
    return 0 if is_same and not failures else 1


def named_runs(planned: Sequence[PlannedRun], names: Sequence[str]) -> list[PlannedRun]:
    """The runs that ``--make-again`` names, on all environments."""
    found: list[PlannedRun] = []
    known = dict.fromkeys(run.agent for run in planned)
    for name in names:
        agent, _, seed = name.rpartition(":")
        if agent not in known:
            raise unknown("--make-again AGENT:SEED: unknown agent", agent, known)
        runs = [run for run in planned if run.agent == agent and str(run.seed) == seed]
        if not runs or runs[0].is_batch:
            raise UserError(f"--make-again: the study has no single run {name}")
        found += runs
    return found


def repair(
    console: Console,
    study: StudySpec,
    planned: Sequence[PlannedRun],
    store: FigureStore | None = None,
) -> None:
    """Move folders of damaged runs and damaged files of runs aside, with a message each."""
    with doing(console, "looking for damaged runs") as activity:
        from rl_yardstick.experiments.run_folders import move_damaged_aside

        files = [] if store is None else store.move_damaged_aside(planned)
        apart = [run for run in planned if store is None or not store.holds(run)]
        moved = move_damaged_aside(study, apart, activity.at)
    for path in files:
        say(console, f"damaged: the file of runs {path.stem}; it is {path.name} now")
    for damaged, place in moved:
        say(console, f"damaged: {whose(damaged)}; its folder is {place.name} now")


def whose(damaged: LeftOut) -> str:
    """A damaged run or batch, and what is damaged."""
    run = damaged.planned
    seeds = (
        f"seeds {run.seed} to {run.seed + run.n_runs - 1}" if run.n_runs > 1 else f"seed {run.seed}"
    )
    return f"{run.agent} on {run.environment}, {seeds}: {damaged.reason}"
