"""The page as one file: it needs nothing else and no network."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, PackageLoader
from markupsafe import Markup

from pipeline.files import write_text
from pipeline.train_spec import TrainSpec
from pipeline.watching.map_recorder import MapRecorder
from pipeline.watching.table_recorder import TableRecorder
from report.learning_page.learning_data import exact_json, maps_data, steps_data
from report.page.markup import inline_script, package_file, packed, script_hash, templates

MOST_BYTES = 2_900_000
SCRIPTS = (
    "learning_replay.js",
    "learning_board.js",
    "learning_readout.js",
    "learning_curves.js",
    "learning_player.js",
)


def write_learning_page(spec: TrainSpec, recorder: TableRecorder | MapRecorder, path: Path) -> None:
    """Write the page of a training.

    Args:
        spec: of the training.
        recorder: what was kept of it.
        path: the file, which is replaced.
    """
    if isinstance(recorder, MapRecorder):
        recorder.record()  # as the agent is at the end, where that was not evaluated
        write_text(path, _render(spec, maps_data(spec, recorder)))
        return
    n_steps = len(recorder.steps)
    text = _render(spec, steps_data(spec, recorder, n_steps))
    while len(text) > MOST_BYTES and n_steps > 1:
        n_steps = n_steps * 3 // 4
        text = _render(spec, steps_data(spec, recorder, n_steps))
    write_text(path, text)


def _render(spec: TrainSpec, data: dict[str, Any]) -> str:
    early = package_file("templates/theme.js")
    own = "\n".join(_file(name) for name in SCRIPTS)
    style = "\n".join([package_file("templates/page.css"), _file("learning.css")])
    environment = templates()
    environment.loader = ChoiceLoader([PackageLoader("report.learning_page")])
    return environment.get_template("learning.html").render(
        title=f"{spec.algo} on {spec.env_id}",
        seed=spec.seed,
        is_steps=data["kind"] == "steps",
        is_cut=data.get("is_cut", False),
        n_episodes=spec.watch_episodes,
        data=packed(exact_json(data)),
        style=Markup(style),  # noqa: S704  # our own
        early=inline_script(early),
        own=inline_script(own),
        policy=" ".join(map(script_hash, [early, own])),
    )


def _file(name: str) -> str:
    return (files("report.learning_page") / "templates" / name).read_text(encoding="utf-8")
