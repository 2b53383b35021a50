"""A run of a study in its draft: from the beginning, or from where another process left it."""

from __future__ import annotations

import shutil
from pathlib import Path

from rich.console import Console

from experiments.bandit_batches import do_batch
from experiments.drafts import claim_draft
from experiments.planned_runs import PlannedRun
from pipeline.run_folder import FINISHED, Run
from pipeline.training import train


class NotFinishedError(Exception):
    """A training came back before its end, though nobody had stopped it."""


def do_or_go_on(planned: PlannedRun, draft: Path, command: str) -> None:
    """Do a run in its draft, to its end.

    Args:
        planned: the run.
        draft: its folder. It is there where another process has left it; it is begun anew then.
        command: the command that asked for the study.

    Raises:
        NotFinishedError: if something in the run ended the training, as Ctrl-C would.
    """
    run = Run(draft, planned.run.env_name)
    claim_draft(draft)
    run.params_path.mkdir()
    if planned.spec.tensorboard_log is not None:
        shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)  # of an earlier try
    if planned.is_batch:
        do_batch(planned.spec, planned.n_runs, run, command)
        return
    args = {"algo": planned.spec.algo, "env": planned.spec.env_id, "seed": planned.seed}
    outcome = train(planned.spec, Console(quiet=True), args, command, run)
    if outcome.state != FINISHED:
        raise NotFinishedError(f"KeyboardInterrupt in the run after {outcome.n_steps:,} steps")
