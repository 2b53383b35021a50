"""What ``compare.py`` does: run what is missing, then judge what is there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from commands.study_progress import StudyProgress
from commands.terminal import table_console
from experiments.execution import RunFailure, available_cores, execute
from experiments.study_plan import PlannedRun, check_settings
from experiments.study_results import StudyResults, read_results
from experiments.study_spec import StudySpec

if TYPE_CHECKING:
    import pandas as pd

    from experiments.analysis import StudyAnalysis


def run_study(
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    command: str,
    *,
    n_workers: int = 0,
    with_page: bool = True,
) -> int:
    """Do a study as planned, print the judgement, and write tables, figures and page.

    Args:
        study: the study.
        planned: its runs.
        root: its folder.
        command: the command that asked for it.
        n_workers: runs at once; 0 for as many as there are cores.
        with_page: draw the figures and write the page, beside the tables.

    Returns:
        The exit code: 1 where a run failed, else 0.

    Raises:
        UserError: if an agent cannot be made with its settings.
    """
    check_settings(study, planned)
    console = table_console()
    console.print(study.title, style="bold", markup=False, highlight=False)
    failures = _do_missing(console, planned, root, command, n_workers or available_cores())
    results = read_results(study, planned, root)
    if len(results.summary):
        _judge(console, results, command, with_page=with_page)
    for failure in failures:
        console.print(
            f"failed: {failure.planned.agent} on {failure.planned.environment}, "
            f"seed {failure.planned.seed}: {failure.reason}; see {failure.log}",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
    return 1 if failures else 0


def _do_missing(
    console: Console, planned: Sequence[PlannedRun], root: Path, command: str, n_workers: int
) -> list[RunFailure]:
    missing = [run for run in planned if not run.is_finished]
    done = [run for run in planned if run.is_finished]
    console.print(
        f"{len(planned)} runs, {len(done)} of them there already; {n_workers} at once, in {root}",
        markup=False,
        highlight=False,
    )
    with StudyProgress(console, planned, done) as progress:
        for run in done:
            progress.note_refusal(run)
        return execute(missing, root, command, n_workers, progress.note)


def _draw(analysis: StudyAnalysis, blocks: pd.DataFrame | None, command: str) -> list[Path]:
    """Figures and the page; the files."""
    from report.figures.figure_files import write_figures
    from report.page import write_report
    from report.series.study_series import study_series

    page = analysis.results.root / "report.html"
    series = study_series(analysis)
    files = write_figures(series, blocks)
    write_report(series, page, command)
    return [*files, page]


def _judge(console: Console, results: StudyResults, command: str, *, with_page: bool) -> None:
    from experiments.analysis import analyse
    from report.result_files import write_tables
    from report.series.episode_blocks import episodes_table
    from report.terminal_tables import print_analysis, print_episodes_table

    analysis = analyse(results)
    print_analysis(console, analysis)
    width = results.study.episodes_table
    blocks = episodes_table(results, width) if width else None
    if blocks is not None:
        print_episodes_table(console, blocks, width)
    files = write_tables(results)
    if results.study.render_every:
        files += _films(console, results)
    if with_page:
        files += _draw(analysis, blocks, command)
    _print_files(console, results.root, files)


def _films(console: Console, results: StudyResults) -> list[Path]:
    """Write the films of training, and say which there cannot be."""
    from report.training_films import write_films

    films, refused = write_films(results)
    for reason in refused:
        console.print(f"no film: {reason}", markup=False, highlight=False)
    return films


def _print_files(console: Console, root: Path, files: Sequence[Path]) -> None:
    console.print()
    console.print(f"files: {root}", markup=False, highlight=False)
    for path in files:
        console.print(f"  {path.relative_to(root)}", markup=False, highlight=False)
