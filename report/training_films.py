"""Films of training: an episode of the first run of each agent now and then, as it explored."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.planned_runs import PlannedRun
from experiments.run_figures import read_episodes
from experiments.study_results import StudyResults
from experiments.study_spec import file_name
from pipeline.environments import MISTAKES
from pipeline.errors import UserError, one_line
from pipeline.evaluation.sampled import evaluation_seed
from pipeline.filming import film_episode, write_film
from pipeline.models.model_choice import ChosenModel, model_of_run
from pipeline.models.model_loading import load_model
from pipeline.playing import playing_env
from pipeline.signs_of_life import Tell, tell_nobody

MAX_STEPS = 500  # fifty seconds


def write_films(results: StudyResults, tell: Tell = tell_nobody) -> tuple[list[Path], list[str]]:
    """Film an episode at each checkpoint of the first run of every agent, into ``films``.

    The agent acts as it did in training, exploration included. A film that is younger than its
    checkpoint is left as it is.

    Returns:
        The files, and for runs that cannot be filmed the reason.
    """
    paths: list[Path] = []
    refused: list[str] = []
    for planned in results.finished:
        is_asked_for = planned.spec.save_every_n_episodes > 0 and not planned.is_batch
        if is_asked_for:
            tell(f"{planned.agent} on {planned.environment}")
            try:
                paths += _films_of(planned, results.root / "films")
            except (UserError, *MISTAKES) as error:
                refused.append(f"{planned.agent} on {planned.environment}: {one_line(error)}")
    return paths, refused


def _films_of(planned: PlannedRun, folder: Path) -> Iterator[Path]:
    name = f"{file_name(planned.agent)}_{file_name(planned.environment)}"
    for checkpoint, episode in _checkpoints(planned):
        path = folder / f"{name}_{episode}.gif"
        if not (path.exists() and path.stat().st_mtime >= checkpoint.stat().st_mtime):
            chosen = model_of_run(checkpoint, planned.spec, planned.run)
            frames = episode_in_training(chosen, evaluation_seed(planned.seed, 4), MAX_STEPS)
            folder.mkdir(exist_ok=True)
            write_film(path, frames)
        yield path


def _checkpoints(planned: PlannedRun) -> Iterator[tuple[Path, int]]:
    """The checkpoints that were due, each with the number of the episode it followed."""
    every = planned.spec.save_every_n_episodes
    ends = read_episodes(planned.run).steps
    for path in planned.run.checkpoints():
        n_steps = int(path.name.split("_")[2])
        n_episodes = int((ends <= n_steps).sum())
        if n_episodes >= every and n_steps in ends:
            yield path, n_episodes // every * every


def episode_in_training(chosen: ChosenModel, seed: int, max_steps: int) -> list[Any]:
    """The frames of an episode, in which the agent samples or explores as it did in training.

    Args:
        chosen: the model.
        seed: of the episode.
        max_steps: after how many steps to stop, where it has not ended before.

    Returns:
        Pictures, uint8 of shape (height, width, 3).

    Raises:
        UserError: if the model cannot be loaded or its environment cannot be drawn.
    """
    import torch as th

    th.set_num_threads(chosen.spec.num_threads)
    env = playing_env(chosen, "rgb_array")
    try:
        model = load_model(chosen.spec.algo, chosen.file, env, chosen.spec.user_modules)
        model.set_random_seed(seed)
        frames, _ = film_episode(model, env, max_steps, deterministic=False)
    finally:
        env.close()
    return frames
