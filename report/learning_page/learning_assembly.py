"""The page as one file: it needs nothing else and no network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, PackageLoader
from markupsafe import Markup

from pipeline.files import write_text
from pipeline.train_spec import TrainSpec
from pipeline.watching.map_recorder import MapRecorder
from pipeline.watching.table_recorder import TableRecorder
from report.learning_page.learning_data import exact_json, maps_data, place_data, steps_data
from report.learning_page.learning_words import NO_WORDS, page_words
from report.page.markup import inline_script, package_file, packed, script_hash, templates

MOST_BYTES = 2_900_000
SCRIPTS = (
    "learning_replay.js",
    "learning_board.js",
    "learning_readout.js",
    "learning_curves.js",
    "learning_steps.js",
    "learning_maps.js",
    "learning_player.js",
)


def write_learning_page(
    spec: TrainSpec, recorder: TableRecorder | MapRecorder, path: Path, title: str = ""
) -> str:
    """Write the page of a training.

    Args:
        spec: of the training.
        recorder: what was kept of it.
        path: the file, which is replaced.
        title: what the training is called; by default the names of agent and environment.

    Returns:
        What it shows, in words.
    """
    place = place_data(spec, recorder)
    title = title or f"{spec.algo} on {spec.env_id}"
    for data in _ever_less(recorder):
        words = page_words(spec, data)
        text = _render({"title": title, "seed": spec.seed, **words}, {**data, **place})
        if len(text.encode()) <= MOST_BYTES:
            break
    write_text(path, text)
    return f"{words['kind']}, {words['extent']}"


@cache
def page_version() -> str:
    """A digest of all that a page is made of but the data."""
    return sha256(_render({"title": "", "seed": 0, **NO_WORDS}, {}).encode()).hexdigest()


def _ever_less(recorder: TableRecorder | MapRecorder) -> Iterator[dict[str, Any]]:
    """What was kept, then three quarters or half of that, and so on as long as there is any."""
    if isinstance(recorder, MapRecorder):
        recorder.finish()
        stride = recorder.stride
        while stride < 2 * max(recorder.n_units, recorder.stride):
            yield maps_data(recorder, stride)
            stride *= 2
        return
    begin, end = recorder.window()
    n_steps = end - begin
    while n_steps:
        yield steps_data(recorder, n_steps)
        n_steps = n_steps * 3 // 4


def _render(words: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    early = package_file("templates/theme.js")
    own = "\n".join(_file(name) for name in SCRIPTS)
    style = "\n".join([package_file("templates/page.css"), _file("learning.css")])
    environment = templates()
    environment.loader = ChoiceLoader(
        [PackageLoader("report.learning_page"), PackageLoader("report.page")]
    )
    return environment.get_template("learning.html").render(
        **words,
        data=packed(exact_json(data)),
        style=Markup(style),  # noqa: S704  # our own
        early=inline_script(early),
        own=inline_script(own),
        policy=" ".join(map(script_hash, [early, own])),
    )


def _file(name: str) -> str:
    return (files("report.learning_page") / "templates" / name).read_text(encoding="utf-8")
