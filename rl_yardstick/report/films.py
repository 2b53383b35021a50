"""Films of agents: how a GIF is written, and which episodes of a study are filmed.

Filming loads PyTorch. A study's own process does not: it calls `film_of` in a child process.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.results import StudyResults
from rl_yardstick.experiments.study import file_name
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.environments import MISTAKES
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.files import replacing, write_json
from rl_yardstick.pipeline.models import Which, load_agent, model_of_run
from rl_yardstick.pipeline.playing import FrameTaker, play_episodes, playing_env
from rl_yardstick.pipeline.run import RECORD, read_episodes

FILM = "episode.gif"
MAX_STEPS = 200  # twenty seconds; a robot that walks in a circle shows it sooner
TRAINING_STEPS = 500  # fifty seconds
COLOURS = 128
MAX_SIDE = 320  # pixels of a picture's longer side
MAX_BYTES = 300_000  # of a film
FRAMES_PER_SECOND = 10


def check_film_path(path: Path) -> None:
    """Check that a film can be written, before anything is played."""
    if path.suffix != ".gif":
        raise UserError(f"--record writes .gif files, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--record: there is no folder {path.parent}")


def write_film(path: Path, frames: list[Any]) -> None:
    """Write frames, uint8 of shape (height, width, 3), as a GIF."""
    with replacing(path) as beside:
        beside.write_bytes(_as_gif(frames))


def _as_gif(frames: list[Any]) -> bytes:
    first, *others = [Image.fromarray(frame) for frame in frames]
    duration, film = 1000 // FRAMES_PER_SECOND, io.BytesIO()
    first.save(film, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return film.getvalue()


def film_of(planned: PlannedRun) -> Path | None:
    """The film of a run's final agent: a GIF, cached in the run folder.

    A JSON file beside it has the episode's return and length. None if filming fails.
    """
    path = planned.path / FILM
    if has_film(planned):
        return path
    from rl_yardstick.pipeline.evaluation.sampled import evaluation_seed

    try:
        with _loaded(planned) as (agent, env):
            env.seed(evaluation_seed(planned.seed, 3))
            frames, ended = _filmed(agent, env, MAX_STEPS, deterministic=True)
    except (UserError, *MISTAKES):
        return None
    frames = _shrunk(frames)
    film = _as_gif(frames)
    n_kept = min(len(frames), max(len(frames) * MAX_BYTES // len(film), 1))
    with replacing(path) as beside:
        beside.write_bytes(film if n_kept == len(frames) else _as_gif(frames[:n_kept]))
    total_return, length = ended or (None, None)
    episode = {"return": total_return, "steps": length, "frames": n_kept}
    write_json(path.with_suffix(".json"), episode)
    return path


def has_film(planned: PlannedRun) -> bool:
    """Whether a film is in the run folder, newer than the run."""
    note = (planned.path / FILM).with_suffix(".json")
    return note.exists() and note.stat().st_mtime >= (planned.path / RECORD).stat().st_mtime


@contextmanager
def _loaded(planned: PlannedRun, which: Which = "final") -> Iterator[tuple[Any, Any]]:
    """An agent of a run, and an environment that draws pictures without a display."""
    import torch as th

    import_modules(planned.spec.gym_packages)
    th.set_num_threads(planned.spec.n_threads)
    model = model_of_run(planned.run, which)
    env = playing_env(model, "rgb_array")
    try:
        yield load_agent(model, env), env
    finally:
        env.close()


def _filmed(
    agent: Any, env: Any, max_steps: int, *, deterministic: bool
) -> tuple[list[Any], tuple[float, int] | None]:
    """The frames of an episode, and its return and length, None if it did not end."""
    taker, frames = FrameTaker(env), list[Any]()
    kept: Any = {"after_step": lambda done: frames.extend(taker.take(done))}
    played = play_episodes(agent, env, 1, max_steps, deterministic=deterministic, **kept)
    return frames, next(((total, length) for total, length, _ in played), None)


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


def write_films(results: StudyResults) -> tuple[list[Path], list[str]]:
    """Film an episode at each checkpoint of the first run of every agent, into ``films``.

    The agent acts as it did in training, exploration included. A film newer than its checkpoint
    is kept. Returns the films, and a reason for each run that cannot be filmed.
    """
    paths: list[Path] = []
    refused: list[str] = []
    for planned in results.finished:
        if planned.spec.save_every_n_episodes > 0 and not planned.is_batch:
            try:
                paths += _films_of_training(planned, results.root / "films")
            except (UserError, *MISTAKES) as error:
                refused.append(f"{planned.agent} on {planned.environment}: {one_line(error)}")
    return paths, refused


def _films_of_training(planned: PlannedRun, folder: Path) -> Iterator[Path]:
    """A film for each checkpoint that was due, named by the number of the episode before it."""
    from rl_yardstick.pipeline.evaluation.sampled import evaluation_seed

    name = f"{file_name(planned.agent)}_{file_name(planned.environment)}"
    every, ends = planned.spec.save_every_n_episodes, read_episodes(planned.path).steps
    for n_steps, checkpoint in planned.run.checkpoints().items():
        n_episodes = int((ends <= n_steps).sum())
        if n_episodes < every or n_steps not in ends:
            continue
        path = folder / f"{name}_{n_episodes // every * every}.gif"
        if not (path.exists() and path.stat().st_mtime >= checkpoint.stat().st_mtime):
            with _loaded(planned, n_steps) as (agent, env):
                agent.set_random_seed(evaluation_seed(planned.seed, 4))
                frames, _ = _filmed(agent, env, TRAINING_STEPS, deterministic=False)
            folder.mkdir(exist_ok=True)
            write_film(path, frames)
        yield path
