"""One run of a study, in the process that does it."""

from __future__ import annotations

from pathlib import Path

from experiments.drafts import draft_path, take_over
from experiments.planned_runs import PlannedRun
from experiments.replaced_runs import make_room, move_aside
from experiments.run_or_go_on import do_or_go_on
from pipeline.file_digests import DamagedFileError
from pipeline.files import kept_later, put_in_place, settle, sync_together
from pipeline.folder_clock import SECONDS_BETWEEN_SIGNS, give_sign
from pipeline.signs_of_life import Heartbeat
from pipeline.user_modules import import_again
from safe_files.files import hold


def do_planned_run(planned: PlannedRun, root: Path, command: str) -> None:
    """As `do_run`, in a draft of this process."""
    hold(root)
    do_run(planned, draft_path(root, planned), command)


def do_run(planned: PlannedRun, draft: Path, command: str) -> None:
    """Train in ``draft``, and rename it into place; another's result that is there stays.

    Where a process that is gone has left the run with a state, it goes on from there.
    """
    import_again(planned.spec.user_modules)
    take_over(draft)
    heart = Heartbeat(lambda: give_sign(draft), SECONDS_BETWEEN_SIGNS)
    heart.start()
    try:
        with kept_later(draft):  # what a power cut leaves of it without a state is begun anew
            do_or_go_on(planned, draft, command)
    finally:
        heart.stop()
    put_run_in_place(planned, draft)


def put_run_in_place(planned: PlannedRun, draft: Path) -> None:
    """Rename a draft that is whole; another's result that is there stays, and others give way."""
    settle(draft)
    try:
        planned.check_record()
    except DamagedFileError:
        move_aside(planned.path)
    make_room(planned, draft.parent.parent)
    planned.path.parent.mkdir(parents=True, exist_ok=True)
    try:
        put_in_place(draft, planned.path)
    except OSError:
        if not planned.is_finished:
            raise
    sync_together([], list(planned.path.parents)[:3])
