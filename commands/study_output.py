"""What ``compare.py`` does: run what is missing, then judge what is there."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from commands.places import Place
from commands.study_progress import StudyProgress
from experiments.launching import EarlyResults, RunFailure, execute
from experiments.plan import PlannedRun
from experiments.run_folders import move_replaced_aside
from experiments.study import StudySpec
from pipeline.signs_of_life import Activity, doing

if TYPE_CHECKING:
    import pandas as pd

    from experiments.analysis import StudyAnalysis
    from experiments.looks import Standing
    from experiments.results import LeftOut, StudyResults
    from report.page.sections import LearningPage


def run_study(
    console: Console,
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    command: str,
    place: Place,
    *,
    with_page: bool = True,
) -> int:
    """Do a study as planned, print the judgement, and write tables, figures and page.

    Args:
        console: where to.
        study: the study.
        planned: its runs, whose settings have been checked.
        root: its folder.
        command: the command that asked for it.
        place: where runs are done.
        with_page: draw the figures and write the page, beside the tables.

    Returns:
        The exit code: 0 if all runs are there and sound, else 1.
    """
    early = EarlyResults(study)
    failures = do_missing(console, planned, root, place, early)
    results = read(console, study, planned, root, early)
    return conclude(
        console, results, failures, command, with_page=with_page, n_workers=place.n_workers
    )


def read(
    console: Console,
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    early: EarlyResults,
) -> StudyResults:
    """Read the runs that there are, but for those that were read early."""
    with doing(console, "reading the results") as activity:
        from experiments.results import read_results

        return read_results(study, planned, root, activity.at, early.of)


def conclude(
    console: Console,
    results: StudyResults,
    failures: Sequence[RunFailure],
    command: str,
    *,
    with_page: bool,
    looks: Mapping[str, Standing] | None = None,
    n_workers: int = 1,
) -> int:
    """Print the judgement, write tables, figures and page, and say which runs are missing and why.

    Args:
        console: where to.
        results: the runs that there are.
        failures: those that failed.
        command: the command that asked for it.
        with_page: draw the figures and write the page, beside the tables.
        looks: by environment, the look that has been taken; None for one that is taken now.
        n_workers: processes at once that train again what the page is to play.

    Returns:
        The exit code, as of `run_study`.
    """
    planned = results.planned
    results = replace(results, failures={one.planned.path: one.details for one in failures})
    try:
        if len(results.summary):
            _judge(console, results, command, looks, n_workers, with_page=with_page)
            _print_mixed_versions(console, results)
    finally:
        for failure in failures:
            _print_failure(console, failure)
        _print_left_out(console, results.left_out)
    if results.n_unchecked:
        runs = "1 run" if results.n_unchecked == 1 else f"{results.n_unchecked} runs"
        say(console, f"{runs} of an earlier version recorded no digests: damage may go unseen")
    n_missing = len(planned) - len(results.finished)
    if n_missing > len(failures) + len(results.left_out):
        say(console, f"{n_missing} of {len(planned)} runs are missing; the same command continues")
    return 1 if n_missing else 0


def _make_way(console: Console, planned: Sequence[PlannedRun], root: Path) -> None:
    moved, place = move_replaced_aside(planned, root)
    if place is not None:
        runs = "1 run that is" if len(moved) == 1 else f"{len(moved)} runs that are"
        say(console, f"{runs} done again: what was there is in {place} now")


def _print_mixed_versions(console: Console, results: StudyResults) -> None:
    from experiments.run_files import mixed_versions

    note = mixed_versions(run.run.read_info() for run in results.finished)
    if note:
        say(console, note)


def repair(console: Console, study: StudySpec, planned: Sequence[PlannedRun]) -> None:
    """Move the folders of damaged runs aside, and say so."""
    with doing(console, "looking for damaged runs") as activity:
        from experiments.run_folders import move_damaged_aside

        moved = move_damaged_aside(study, planned, activity.at)
    for damaged, place in moved:
        say(console, f"damaged: {_whose(damaged)}; its folder is {place.name} now")


def _print_failure(console: Console, failure: RunFailure) -> None:
    run = failure.planned
    details = "the details could not be written" if failure.log is None else f"see {failure.log}"
    say(
        console,
        f"failed: {run.agent} on {run.environment}, seed {run.seed}: {failure.reason}; {details}",
    )


def _print_left_out(console: Console, left_out: Sequence[LeftOut]) -> None:
    for damaged in left_out:
        say(console, f"left out: {_whose(damaged)}")
    if left_out:
        n_runs = sum(damaged.planned.n_runs for damaged in left_out)
        runs = "1 run is" if n_runs == 1 else f"{n_runs} runs are"
        say(console, f"{runs} damaged and in no figure; --repair does such runs again")


def _whose(damaged: LeftOut) -> str:
    run = damaged.planned
    seeds = (
        f"seeds {run.seed} to {run.seed + run.n_runs - 1}" if run.n_runs > 1 else f"seed {run.seed}"
    )
    return f"{run.agent} on {run.environment}, {seeds}: {damaged.reason}"


def say(console: Console, line: str) -> None:
    """Print a line as it is."""
    console.print(line, highlight=False, soft_wrap=True)


def do_missing(
    console: Console,
    planned: Sequence[PlannedRun],
    root: Path,
    place: Place,
    early: EarlyResults,
    given_up: Collection[Path] = (),
) -> list[RunFailure]:
    """Do the runs that are missing, but for those whose folders are given up; which failed.

    Each is read as soon as it has ended.
    """
    _make_way(console, planned, root)
    missing = [run for run in planned if run.is_to_do and run.path not in given_up]
    done = [run for run in planned if run.is_finished]
    console.print(
        f"{len(planned)} runs, {len(done)} of them there already; {place.words}, in {root}",
        highlight=False,
    )
    begun = [*done, *missing]
    with StudyProgress(console, begun, done, place.expected) as progress:
        for run in done:
            progress.note_refusal(run)

        def note(planned: PlannedRun, failure: RunFailure | None) -> None:
            progress.note(planned, failure)
            if failure is None:
                early.read(planned)

        return execute(missing, root, progress.watching(place.launchers), note, early.get_ready)


def _judge(
    console: Console,
    results: StudyResults,
    command: str,
    looks: Mapping[str, Standing] | None,
    n_workers: int,
    *,
    with_page: bool,
) -> None:
    with doing(console, "judging the agents") as activity:
        from experiments.analysis import analyse, with_advice
        from experiments.growing import take_looks
        from report.terminal_tables import print_analysis, print_episodes_table

        analysis = analyse(results, activity.at, take_looks(results) if looks is None else looks)
        activity.now("looking at runs that failed")
        analysis = with_advice(analysis)
    print_analysis(console, analysis)
    width = results.study.episodes_table
    with doing(console, "writing the tables") as activity:
        from experiments.study import write_study
        from report.result_files import write_tables, write_verdicts
        from report.series.episode_blocks import episodes_table

        files = [*write_tables(results), *write_verdicts(analysis, command)]
        write_study(results.root, results.study)
        blocks = episodes_table(results, width) if width else None
        if blocks is not None:
            print_episodes_table(console, blocks, width)
        if results.study.render_every:
            files += _films(results, activity)
        if with_page:
            files += _draw(analysis, blocks, command, activity, n_workers)
    _print_files(console, results.root, files)


def _draw(
    analysis: StudyAnalysis,
    blocks: pd.DataFrame | None,
    command: str,
    activity: Activity,
    n_workers: int,
) -> list[Path]:
    """Figures and the page; the files."""
    activity.now("working out the curves")
    from report.figures.figure_files import write_figures
    from report.page import write_report
    from report.series.study_series import study_series

    page = analysis.results.root / "report.html"
    series = study_series(analysis, activity.at)
    activity.now("drawing the figures")
    files = write_figures(series, blocks, activity.at)
    learning: list[LearningPage] = []
    if analysis.study.learning_pages:
        activity.now("watching")
        from report.learning_page.first_runs import write_first_pages

        learning = write_first_pages(analysis, n_workers, activity.at)
    activity.now("writing the page")
    write_report(series, page, command, activity.at, learning)
    pages = [analysis.results.root / one.place for one in learning if one.place]
    return [*files, *pages, page]


def _films(results: StudyResults, activity: Activity) -> list[Path]:
    """Write the films of training, and say which there cannot be."""
    activity.now("filming")
    from report.films import write_films

    films, refused = write_films(results, activity.at)
    for reason in refused:
        activity.say(f"no film: {reason}")
    return films


def _print_files(console: Console, root: Path, files: Sequence[Path]) -> None:
    console.print()
    console.print(f"files: {root}", highlight=False)
    for path in files:
        console.print(f"  {path.relative_to(root)}", highlight=False)
