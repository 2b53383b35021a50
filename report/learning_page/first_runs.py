"""The first training of each agent of a study, done again to be played."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from experiments.analysis import StudyAnalysis
from experiments.child_processes import TaskFailedError, local_executor, supervise
from experiments.plan import PlannedRun
from experiments.run_files import difference
from experiments.run_limits import RunLimits
from pipeline.errors import UserError
from pipeline.signs_of_life import Tell, tell_nobody
from pipeline.train_spec import is_plain
from pipeline.training import carry_out, prepare
from pipeline.unfinished_runs import SaveInterval, StateKeeping
from pipeline.user_modules import import_again
from report.learning_page.kept_pages import kept_page, note_page, page_path, without_page
from report.learning_page.learning_assembly import write_learning_page
from report.page.sections import LearningPage, first_runs
from safe_files.files import hold

BATCH = "its runs were done as one batch, which leaves no agent"
WITHOUT_STATES = StateKeeping(SaveInterval(is_off=True))


def write_first_pages(
    analysis: StudyAnalysis, n_workers: int, tell: Tell = tell_nobody
) -> list[LearningPage]:
    """Write a page for the first run of each agent, into ``learning``; those that fit stay.

    Args:
        analysis: the study.
        n_workers: trainings at once; each is done in a child process.
        tell: told how far it is.

    Returns:
        The pages, and of agents that cannot be shown the reason.
    """
    root, study = analysis.results.root, analysis.study
    runs = [run for group in first_runs(analysis) for run in group]
    kept = {run.path: kept_page(root, run) for run in runs}
    to_do = [run for run in runs if kept[run.path] is None]
    if to_do:
        limits = RunLimits(study.run_timeout, study.run_memory)
        with local_executor(n_workers) as executor:
            kept |= _trained_again(executor, root, to_do, limits, tell)
    pages = [page for page in kept.values() if page is not None]
    return pages + _without_run(analysis, pages)


def _without_run(analysis: StudyAnalysis, pages: list[LearningPage]) -> list[LearningPage]:
    """The agents of which there is no run that could be trained again."""
    there = {(page.agent, page.environment) for page in pages}
    batches = {(run.agent, run.environment) for run in analysis.results.finished if run.is_batch}
    without = [
        (agent.agent, one.environment)
        for one in analysis.environments
        for agent in one.agents
        if (agent.agent, one.environment) not in there
    ]
    return [
        LearningPage(*names, 0, "", BATCH if names in batches else "no run of it has finished")
        for names in without
    ]


def _trained_again(
    executor: Executor, root: Path, runs: list[PlannedRun], limits: RunLimits, tell: Tell
) -> Iterator[tuple[Path, LearningPage]]:
    futures = [executor.submit(_watched, root, run, limits) for run in runs]
    for n, (run, future) in enumerate(zip(runs, futures, strict=True), start=1):
        tell(f"training again to be watched, {n} of {len(runs)}: {run.agent} on {run.environment}")
        yield run.path, future.result()


def _watched(root: Path, run: PlannedRun, limits: RunLimits) -> LearningPage:
    """The page of a run, written by a child process."""
    path = page_path(root, run)
    with TemporaryDirectory(prefix="yardstick-learning-", ignore_cleanup_errors=True) as folder:
        try:
            words = supervise(
                _train_again,
                run,
                path,
                Path(folder),
                clean_up=partial(shutil.rmtree, folder, ignore_errors=True),
                limits=limits,
                shares_process=is_plain(run.spec),
            )
        except TaskFailedError as error:
            path.unlink(missing_ok=True)
            return without_page(run, str(error))
    return note_page(root, run, words)


def _train_again(planned: PlannedRun, path: Path, folder: Path) -> str:
    """Train in ``folder`` and write the page of it; what that shows, in words.

    Raises:
        UserError: if the agent cannot be watched, or has become another one than that of the run.
    """
    hold(path.parents[2])  # the study
    import_again(planned.spec.user_modules)
    spec = replace(planned.spec, log_folder=folder, tensorboard_log=None, watch_learning=path)
    training = prepare(spec, Console(quiet=True), {}, "", keeping=WITHOUT_STATES)
    carry_out(training)
    what = difference(planned.run, training.run)
    if what:
        raise UserError(
            f"{what} came out otherwise than in the run, as with another version or processor"
        )
    assert training.watch is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"{planned.agent} on {planned.environment}"
    return write_learning_page(spec, training.watch, path, title)
