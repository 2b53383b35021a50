"""What becomes of a run that breaks: everything closed, the reason noted, the folder left true."""

from __future__ import annotations

from contextlib import ExitStack, suppress

from pipeline.errors import UserError, one_line
from pipeline.exhaustion import exhaustion
from pipeline.files import DISK_ERRORS
from pipeline.foreign_exits import exits_as_mistakes
from pipeline.library_errors import LibraryError
from pipeline.locks import FolderGoneError, is_gone
from pipeline.preparation import Training
from pipeline.run_folder import INTERRUPTED
from pipeline.worker_processes import close_environments


@exits_as_mistakes()
def close(training: Training) -> None:
    """Close what is open, each part also where another cannot be closed."""
    model = training.model
    with ExitStack() as stack:
        if model.env is not None:
            stack.callback(close_environments, model.env)
        stack.callback(close_environments, training.eval_env)
        if hasattr(model, "_logger"):
            stack.callback(model.logger.close)


def has_begun(training: Training) -> bool:
    """Whether there is something that was learnt, by this process or the ones before it."""
    model, is_back = training.model, training.saver.state is None
    return is_back and model.num_timesteps > model._num_timesteps_at_start


def give_up(training: Training, error: BaseException) -> None:
    """Note the reason; or remove the folder, where the agent failed before its first step.

    Raises:
        UserError: in that case, where the agent's settings are at fault; and where the disk takes
            no more, or somebody has removed the folder.
    """
    run, is_new = training.run, not training.keeping.goes_on
    if is_gone(run.path):
        raise FolderGoneError(run.path) from error
    is_expected = isinstance(error, ValueError | OSError | KeyboardInterrupt | LibraryError)
    if is_new and is_expected and not has_begun(training):
        run.discard()
        if not isinstance(error, ValueError):  # the others say for themselves what it was
            return
        message = f"{training.spec.algo} on {run.env_name}: {one_line(error)}"
        raise UserError(message) from error
    with suppress(OSError):  # what the run has failed by says more
        training.evaluation.write()
    if isinstance(error, KeyboardInterrupt) or training.saver.state is not None:
        run.update_info(state=INTERRUPTED)
        return
    run.fail(one_line(error))
    if isinstance(error, OSError) and error.errno in DISK_ERRORS:
        when = f"the run has failed at step {training.model.num_timesteps:,}"
        raise UserError(f"{error.filename}: {error.strerror}: {when}") from error


def is_of_the_machine(error: BaseException | None) -> bool:
    """Whether a run has failed by a full disk or memory, and by no fault of its own."""
    while error is not None:
        is_of_disk = isinstance(error, OSError) and error.errno in DISK_ERRORS
        if is_of_disk or exhaustion(error) is not None:
            return True
        error = error.__cause__
    return False
