"""Which figures a study has, and the files that they become."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from experiments.study import file_name
from pipeline.signs_of_life import Tell, tell_nobody
from report.figures.bandit_figures import (
    draw_arms,
    draw_belief,
    draw_regret,
    draw_rewards,
    draw_simple_regret,
)
from report.figures.figure_style import FigureFiles
from report.figures.study_figures import (
    draw_blocks,
    draw_grid,
    draw_learning_curves,
    draw_profiles,
    draw_runs,
    draw_sweeps,
    name_blocks,
    panels,
)
from report.series.agent_marks import Mark
from report.series.pull_series import PullSeries
from report.series.study_series import EnvironmentSeries, StudySeries

# More agents than this make no readable lines; a study of parameters shows them by parameter.
MOST_LINES = 14
MOST_IN_PAIRS = 8  # panels that have a page in two columns; more stand in three

Marks = Mapping[str, Mark]


def write_figures(
    series: StudySeries, episodes_table: pd.DataFrame | None, tell: Tell = tell_nobody
) -> list[Path]:
    """Draw all figures that the study has the runs for, into its folder ``figures``.

    Args:
        series: what they show.
        episodes_table: from `report.series.episode_blocks`, or None for no such figure.
        tell: told how far the drawing is.

    Returns:
        The files.
    """
    files = FigureFiles(series.analysis.results.root / "figures", series.analysis.study.figures)
    files.folder.mkdir(exist_ok=True)
    for one in series.environments:
        if one.pulls is not None:
            name = one.environment.environment
            tell(name)
            _bandit_figures(files, one.pulls, name, series.marks)
    for one in series.environments:
        tell(one.environment.environment)
        _study_figures(files, series, one, episodes_table)
    if series.analysis.overall is not None:
        tell("all environments")
        with files.figure("performance_profiles") as (axes,):
            draw_profiles(axes, series.analysis.overall, series.marks)
    return files.written


def _study_figures(
    files: FigureFiles, series: StudySeries, one: EnvironmentSeries, blocks: pd.DataFrame | None
) -> None:
    environment, metric, marks = one.environment, series.analysis.study.metric, series.marks
    name = file_name(environment.environment)
    if one.sweeps:
        with files.figure(f"{name}_sweep") as (axes,):
            draw_sweeps(axes, one.sweeps, environment, metric)
    for group, grid in one.grids.items():
        title = environment.environment + (f", {group}" if len(one.grids) > 1 else "")
        height = 1.6 + 0.4 * len(grid.down)
        with files.figure(f"{name}_{file_name(group)}_grid", height=height) as (axes,):
            draw_grid(axes, grid, title, environment, metric)
    if len(environment.agents) > MOST_LINES or one.curves is None:
        return
    if n_columns := len(panels(one.curves)):
        with files.figure(f"{name}_learning_curves", n_columns) as places:
            draw_learning_curves(places, one.curves, environment, marks)
    with files.figure(f"{name}_intervals") as (axes,):
        draw_runs(axes, one.runs, environment, metric, marks)
    if blocks is not None:
        rows = blocks[blocks["environment"] == environment.environment]
        _block_figure(files, f"{name}_episodes", rows, marks)


def _block_figure(files: FigureFiles, name: str, rows: pd.DataFrame, marks: Marks) -> None:
    agents = list(dict.fromkeys(rows["agent"]))
    if agents:
        n_columns = min(len(agents), 2 if len(agents) <= MOST_IN_PAIRS else 3)
        n_rows = -(-len(agents) // n_columns)
        with files.figure(name, n_columns, n_rows, height=2.2) as places:
            for axes, agent in zip(places, agents, strict=False):
                draw_blocks(axes, rows[rows["agent"] == agent], marks[agent])
            for axes in places[len(agents) :]:
                axes.set_visible(False)
            name_blocks(places[0])


def _bandit_figures(files: FigureFiles, pulls: PullSeries, place: str, marks: Marks) -> None:
    name = file_name(place)
    if len(pulls.pulls) <= MOST_LINES:
        with files.figure(f"{name}_pulls", n_rows=2) as (upper, lower):
            draw_rewards(upper, lower, pulls, place, marks)
        with files.figure(f"{name}_regret", n_rows=1 + pulls.has_simple_regret) as (upper, *others):
            draw_regret(upper, pulls, place, marks)
            for axes in others:
                draw_simple_regret(axes, pulls, marks)
    if pulls.arms is not None and len(pulls.arms.shares) <= MOST_LINES:
        with files.figure(f"{name}_arms", n_rows=2) as (upper, lower):
            draw_arms(upper, lower, pulls.arms, marks)
    for belief in pulls.beliefs:
        n_moments, n_contexts = belief.densities.shape[:2]
        n_columns = 2 if n_moments % 2 == 0 else 1
        n_rows = n_moments * n_contexts // n_columns
        path = f"{name}_{file_name(belief.agent)}_posteriors"
        with files.figure(path, n_columns, n_rows, height=2.2) as places:
            draw_belief(places, belief)
