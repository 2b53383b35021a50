"""An episode of each agent as an animated picture inside the page."""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments.planned_runs import PlannedRun
from pipeline.environments import MISTAKES
from pipeline.errors import UserError
from pipeline.evaluation.sampled import evaluation_seed
from pipeline.files import replacing, write_json
from pipeline.filming import as_gif, film_episode
from pipeline.models.model_choice import model_of_run
from pipeline.models.model_loading import load_model
from pipeline.playing import playing_env
from report.page.markup import data_uri
from report.page.sections import Report, Section, first_runs
from report.wording import number
from safe_files.regular_files import NO_LIMIT, read_file

MAX_STEPS = 200  # twenty seconds; a robot that walks in a circle shows it sooner
COLOURS = 128
MAX_SIDE = 320  # pixels of a picture's longer side
MAX_BYTES = 300_000  # of a film
MAX_FIGURE = 1e300  # in the caption
ALL_BYTES = 1_000_000  # of the films of a page, a third more as text


@dataclass(frozen=True)
class Film:
    """A greedy episode of an agent.

    Attributes:
        agent: its label.
        still: the first frame as a data URI.
        place: that of its film among those of the page, which agents of one route share.
        width, height: in pixels.
        caption: how the episode went.
    """

    agent: str
    still: str
    place: int
    width: int
    height: int
    caption: str


def section(report: Report) -> Section | None:
    """The films of each environment; None where nothing can be drawn."""
    groups: list[list[Film]] = []
    contents: dict[bytes, int] = {}  # and their places on the page
    without_room: list[list[str]] = []
    runs_to_film = first_runs(report.analysis)
    for n_done, runs in enumerate(runs_to_film, start=1):
        groups.append([])
        without_room.append([])
        for run in runs:
            report.tell(f"filming {run.agent} on {run.environment}")
            path = film_of(run)
            if path is None:
                continue
            content = read_file(path, NO_LIMIT)
            # What an environment does not take is left to the next ones.
            room = ALL_BYTES * n_done // len(runs_to_film) - sum(map(len, contents))
            if content in contents or len(content) <= room:
                place = contents.setdefault(content, len(contents))
                groups[-1].append(_film(run.agent, path, content, place))
            else:
                without_room[-1].append(run.agent)
    if not any(groups):
        return None
    data = [data_uri("image/gif", content) for content in contents]
    context = {"films": groups, "without_room": without_room}
    return Section("films", "Episodes", context, data, by_environment=True)


def film_of(planned: PlannedRun) -> Path | None:
    """The film of a run's final agent, kept in the run folder for the next page.

    Returns:
        A GIF, which has how the episode went beside it in a JSON file; None where the environment
        cannot be drawn.
    """
    path = planned.path / "episode.gif"
    if not _is_kept(path):
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


def _is_kept(path: Path) -> bool:
    """Whether a film and how it went lie there, as this module leaves them."""
    try:
        episode = json.loads(read_file(path.with_suffix(".json"), MAX_BYTES))
        # Films are no part of the run, so that it has no digest of them.
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
    """The frames of an episode, and how it went."""
    import torch as th

    # Pictures alone: no display is needed, nor looked for.
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    spec = planned.spec
    th.set_num_threads(spec.num_threads)
    chosen = model_of_run(planned.run.model_path, spec, planned.run)
    env = playing_env(chosen, "rgb_array")
    try:
        model = load_model(spec.algo, chosen.file, env, spec.user_modules)
        env.seed(evaluation_seed(planned.seed, 3))
        frames, ended = film_episode(model, env, MAX_STEPS, deterministic=True)
    finally:
        env.close()
    total_return, length = ended or (None, None)
    return _shrunk(frames), {"return": total_return, "steps": length}


def _shrunk(frames: list[Any]) -> list[Any]:
    """The frames, small and in few colours that they share.

    What does not move then looks the same in all of them, and takes no room in the film.
    """
    factor = -(-max(frames[0].shape[:2]) // MAX_SIDE)
    pictures = [Image.fromarray(frame).reduce(factor) for frame in frames]
    samples = [pictures[0], pictures[len(pictures) // 2], pictures[-1]]
    palette = Image.fromarray(np.hstack([np.asarray(p) for p in samples])).quantize(COLOURS)
    few = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    return [np.asarray(picture.convert("RGB")) for picture in few]


def _film(agent: str, path: Path, content: bytes, place: int) -> Film:
    still = io.BytesIO()
    with Image.open(io.BytesIO(content)) as picture:
        width, height = picture.size
        picture.convert("RGB").quantize(64).save(still, "PNG", optimize=True)
    return Film(
        agent,
        data_uri("image/png", still.getvalue()),
        place,
        width,
        height,
        _caption(json.loads(read_file(path.with_suffix(".json"), MAX_BYTES))),
    )


def _caption(episode: dict[str, Any]) -> str:
    shown, steps = episode["frames"] - 1, episode["steps"]
    if steps is None:
        return f"the first {shown} steps"
    result = f"return {number(episode['return'])} in {steps} step{'s' if steps > 1 else ''}"
    return result if shown >= steps else f"{result}, of which these are the first {shown}"
