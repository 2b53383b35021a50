"""One run of a study in the process that does it: from the beginning, or going on from a state."""

from __future__ import annotations

import shutil
from pathlib import Path

from rich.console import Console

from experiments.plan import PlannedRun
from experiments.run_folders import (
    claim_draft,
    holds_state,
    put_run_in_place,
    take_over,
)
from pipeline.errors import UserError
from pipeline.failures import is_of_the_machine
from pipeline.locks import SECONDS_BETWEEN_SIGNS, give_sign
from pipeline.runs import Run, remove_states
from pipeline.signs_of_life import Heartbeat
from pipeline.training import train
from pipeline.unfinished_runs import StateKeeping, go_on
from pipeline.user_modules import import_again


def do_run(planned: PlannedRun, draft: Path, command: str) -> None:
    """Train in ``draft``, and rename it into place; another's result that is there stays.

    Where a process that is gone has left the run with a state, it goes on from there.
    """
    import_again(planned.spec.user_modules)
    take_over(draft)
    heart = Heartbeat(lambda: give_sign(draft), SECONDS_BETWEEN_SIGNS)
    heart.start()
    try:
        _do_or_go_on(planned, draft, command)
    finally:
        heart.stop()
    put_run_in_place(planned, draft)


def _do_or_go_on(planned: PlannedRun, draft: Path, command: str) -> None:
    """Do a run in its draft, to its end.

    The draft is there where another process has left it: the run goes on from its state if that is
    whole, of these very settings, and saved by these very sources, and else begins anew.
    """
    run = Run(draft, planned.run.env_name)
    keeping = _to_go_on_with(planned, run)
    if not keeping.goes_on:
        _begin_anew(planned, run)
    if planned.is_batch:
        from experiments.bandits import do_batch  # with pandas, which no other run needs

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
        keeping = go_on(run, StateKeeping(), str)  # the report on a run is its folder
    except UserError:  # it is damaged, or another user's
        return anew
    is_ours = keeping.state is None or keeping.state.is_of_these_sources
    return keeping if is_ours else anew


def _begin_anew(planned: PlannedRun, run: Run) -> None:
    claim_draft(run.path)
    run.params_path.mkdir()
    if planned.spec.tensorboard_log is not None:
        shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)  # of an earlier try
