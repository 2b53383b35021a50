"""An episode of each agent as an animated picture inside the page."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from experiments.child_processes import do_aside
from report.films import MAX_BYTES, films_of, has_film
from report.page.markup import data_uri
from report.page.sections import Report, Section, first_runs
from report.wording import number
from safe_files.files import NO_LIMIT, read_file

MOST_FILMED = 8  # agents of an environment, the best of them
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
    not_filmed: list[list[str]] = []
    ranked = first_runs(report.analysis)
    to_film = [run for runs in ranked for run in runs[:MOST_FILMED]]
    report.tell("filming episodes")
    made = films_of(to_film) if all(map(has_film, to_film)) else do_aside(films_of, to_film)
    paths = dict(zip((run.path for run in to_film), made, strict=True))
    for n_done, runs in enumerate(ranked, start=1):
        groups.append([])
        without_room.append([])
        not_filmed.append([run.agent for run in runs[MOST_FILMED:]])
        for run in runs[:MOST_FILMED]:
            path = paths[run.path]
            if path is None:
                continue
            content = read_file(path, NO_LIMIT)
            # What an environment does not take is left to the next ones.
            room = ALL_BYTES * n_done // len(ranked) - sum(map(len, contents))
            if content in contents or len(content) <= room:
                place = contents.setdefault(content, len(contents))
                groups[-1].append(_film(run.agent, path, content, place))
            else:
                without_room[-1].append(run.agent)
    if not any(groups):
        return None
    data = [data_uri("image/gif", content) for content in contents]
    context = {"films": groups, "without_room": without_room, "not_filmed": not_filmed}
    return Section("films", "Episodes", context, data, by_environment=True)


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
