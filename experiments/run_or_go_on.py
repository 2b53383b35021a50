"""A run of a study in its draft: from the beginning, or from where another process left it."""

from __future__ import annotations

import shutil
from pathlib import Path

from rich.console import Console

from experiments.drafts import claim_draft, holds_state
from experiments.planned_runs import PlannedRun
from pipeline.broken_runs import is_of_the_machine
from pipeline.errors import UserError
from pipeline.run_files import remove_states
from pipeline.run_folder import Run
from pipeline.training import train
from pipeline.unfinished_runs import StateKeeping, go_on


def do_or_go_on(planned: PlannedRun, draft: Path, command: str) -> None:
    """Do a run in its draft, to its end.

    Args:
        planned: the run.
        draft: its folder. It is there where another process has left it: the run goes on from its
            state if that is whole, of these very settings, and saved by these very sources, and
            else begins anew.
        command: the command that asked for the study.
    """
    run = Run(draft, planned.run.env_name)
    keeping = _to_go_on_with(planned, run)
    if not keeping.goes_on:
        _begin_anew(planned, run)
    if planned.is_batch:
        from experiments.bandit_batches import do_batch

        do_batch(planned.spec, planned.n_runs, run, command)
        return
    args = {"algo": planned.spec.algo, "env": planned.spec.env_id, "seed": planned.seed}
    try:
        train(planned.spec, Console(quiet=True), args, command, run, keeping)
    except Exception as error:
        if not is_of_the_machine(error):
            remove_states(run.state_path)  # the next try begins anew, maybe with other code
        raise


def _to_go_on_with(planned: PlannedRun, run: Run) -> StateKeeping:
    """The state that another process has left, where there is one."""
    anew = StateKeeping(was_cut_off=run.path.is_dir())
    if planned.is_batch or not holds_state(run.path) or not planned.is_of(run):
        return anew
    try:
        keeping = go_on(run, StateKeeping(), _say_to_nobody)
    except UserError:  # it is damaged, or another user's
        return anew
    is_ours = keeping.state is None or keeping.state.is_of_these_sources
    return keeping if is_ours else anew


def _begin_anew(planned: PlannedRun, run: Run) -> None:
    claim_draft(run.path)
    run.params_path.mkdir()
    if planned.spec.tensorboard_log is not None:
        shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)  # of an earlier try


def _say_to_nobody(line: str) -> None:
    """The report on a run is its folder."""
