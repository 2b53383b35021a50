"""Films of agents: an episode of each run's final agent, and of its exploration in training.

Filming loads PyTorch. A study's own process does not: it calls `films_of` in a child process.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.study import file_name
from rl_yardstick.pipeline.environments import MISTAKES
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.files import replacing, write_json
from rl_yardstick.pipeline.signs_of_life import Tell, tell_nobody
from rl_yardstick.safe_files.files import read_file

if TYPE_CHECKING:
    from rl_yardstick.experiments.results import StudyResults
    from rl_yardstick.pipeline.models.choose import ChosenModel

FILM = "episode.gif"
MAX_STEPS = 200  # twenty seconds; a robot that walks in a circle shows it sooner
TRAINING_STEPS = 500  # fifty seconds
COLOURS = 128
MAX_SIDE = 320  # pixels of a picture's longer side
MAX_BYTES = 300_000  # of a film
MAX_FIGURE = 1e300  # largest number in a caption


def films_of(runs: Sequence[PlannedRun]) -> list[Path | None]:
    """The film of each run, made if it is missing, see `film_of`."""
    return [film_of(run) for run in runs]


def film_of(planned: PlannedRun) -> Path | None:
    """The film of a run's final agent: a GIF, cached in the run folder.

    A JSON file beside it has the episode's return and length. None if filming fails.
    """
    path = planned.path / FILM
    if not has_film(planned):
        from rl_yardstick.pipeline.playing import as_gif

        try:
            frames, episode = _play(planned)
        except (UserError, *MISTAKES):
            return None
        film = as_gif(frames)
        kept = min(len(frames), max(len(frames) * MAX_BYTES // len(film), 1))
        if kept < len(frames):
            film = as_gif(frames[:kept])
        with replacing(path) as file:
            file.write(film)
        write_json(path.with_suffix(".json"), {**episode, "frames": kept})
    return path


def has_film(planned: PlannedRun) -> bool:
    """Whether a valid film of a run and its JSON file are in the run folder."""
    path = planned.path / FILM
    try:
        episode = json.loads(read_file(path.with_suffix(".json"), MAX_BYTES))
        # A film is not part of the run, which has no digest of it: check the content.
        with Image.open(io.BytesIO(read_file(path, 2 * MAX_BYTES)), formats=["GIF"]) as picture:
            is_small = max(picture.size) <= MAX_SIDE
            picture.load()
        numbers = [episode["frames"], episode["return"] or 0.0, episode["steps"] or 0]
    except (OSError, ValueError, LookupError, TypeError, RecursionError, SyntaxError):
        return False
    return is_small and all(
        isinstance(one, int | float) and abs(one) < MAX_FIGURE for one in numbers
    )


def _play(planned: PlannedRun) -> tuple[list[Any], dict[str, Any]]:
    """The frames of an episode, and its return and length (None if it did not end)."""
    from rl_yardstick.pipeline.evaluation.sampled import evaluation_seed
    from rl_yardstick.pipeline.models.choose import model_of_run
    from rl_yardstick.pipeline.playing import film_episode

    # Draw without a display.
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    with _loaded(model_of_run(planned.run.model_path, planned.spec, planned.run)) as (model, env):
        env.seed(evaluation_seed(planned.seed, 3))
        frames, ended = film_episode(model, env, MAX_STEPS, deterministic=True)
    total_return, length = ended or (None, None)
    return _shrunk(frames), {"return": total_return, "steps": length}


@contextmanager
def _loaded(chosen: ChosenModel) -> Iterator[tuple[Any, Any]]:
    """A model, and an environment that draws pictures."""
    import torch as th

    from rl_yardstick.pipeline.models.load import load_model
    from rl_yardstick.pipeline.playing import playing_env

    th.set_num_threads(chosen.spec.num_threads)
    env = playing_env(chosen, "rgb_array")
    try:
        yield load_model(chosen.spec.algo, chosen.file, env, chosen.spec.user_modules), env
    finally:
        env.close()


def _shrunk(frames: list[Any]) -> list[Any]:
    """The frames, scaled down and with one palette for all.

    A pixel that does not change is then the same in all frames, and takes no space in the film.
    """
    factor = -(-max(frames[0].shape[:2]) // MAX_SIDE)
    pictures = [Image.fromarray(frame).reduce(factor) for frame in frames]
    samples = [pictures[0], pictures[len(pictures) // 2], pictures[-1]]
    palette = Image.fromarray(np.hstack([np.asarray(p) for p in samples])).quantize(COLOURS)
    few = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    return [np.asarray(picture.convert("RGB")) for picture in few]


def write_films(results: StudyResults, tell: Tell = tell_nobody) -> tuple[list[Path], list[str]]:
    """Film an episode at each checkpoint of the first run of every agent, into ``films``.

    The agent acts as it did in training, exploration included. A film newer than its checkpoint
    is kept. Returns the films, and a reason for each run that cannot be filmed.
    """
    paths: list[Path] = []
    refused: list[str] = []
    for planned in results.in_folders:
        if planned.spec.save_every_n_episodes > 0 and not planned.is_batch:
            tell(f"{planned.agent} on {planned.environment}")
            try:
                paths += _films_of(planned, results.root / "films")
            except (UserError, *MISTAKES) as error:
                refused.append(f"{planned.agent} on {planned.environment}: {one_line(error)}")
    return paths, refused


def _films_of(planned: PlannedRun, folder: Path) -> Iterator[Path]:
    from rl_yardstick.pipeline.evaluation.sampled import evaluation_seed
    from rl_yardstick.pipeline.models.choose import model_of_run
    from rl_yardstick.pipeline.playing import write_film

    name = f"{file_name(planned.agent)}_{file_name(planned.environment)}"
    for checkpoint, episode in _checkpoints(planned):
        path = folder / f"{name}_{episode}.gif"
        if not (path.exists() and path.stat().st_mtime >= checkpoint.stat().st_mtime):
            chosen = model_of_run(checkpoint, planned.spec, planned.run)
            frames = episode_in_training(chosen, evaluation_seed(planned.seed, 4), TRAINING_STEPS)
            folder.mkdir(exist_ok=True)
            write_film(path, frames)
        yield path


def _checkpoints(planned: PlannedRun) -> Iterator[tuple[Path, int]]:
    """The checkpoints that were due, each with the number of the episode it followed."""
    from rl_yardstick.experiments.results import read_episodes

    every = planned.spec.save_every_n_episodes
    ends = read_episodes(planned.run).steps
    for path in planned.run.checkpoints():
        n_steps = int(path.name.split("_")[2])
        n_episodes = int((ends <= n_steps).sum())
        if n_episodes >= every and n_steps in ends:
            yield path, n_episodes // every * every


def episode_in_training(chosen: ChosenModel, seed: int, max_steps: int) -> list[Any]:
    """The frames of an episode, in which the agent samples or explores as it did in training."""
    from rl_yardstick.pipeline.playing import film_episode

    with _loaded(chosen) as (model, env):
        model.set_random_seed(seed)
        frames, _ = film_episode(model, env, max_steps, deterministic=False)
    return frames
