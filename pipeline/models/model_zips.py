"""What a zip says of the agent in it, without making an agent of it: only plain JSON is read."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from agents import ALGORITHMS, load_algorithm
from pipeline.errors import UserError, one_line
from pipeline.models.recorded_runs import read_recorded
from pipeline.run_folder import Run
from pipeline.train_spec import TrainSpec

# Folders of `agents` in which no agent has a zip with a pickle: known before any is imported.
_JSON_FAMILIES = {"tabular", "linear", "bandits", "mabwiser"}


@dataclass(frozen=True)
class ModelFile:
    """A zip, read once: what is held against its digest, looked into and loaded are these bytes.

    Whoever puts another file in its place meanwhile changes nothing.

    Attributes:
        path: where it lay.
        content: all of it.
        data: the JSON in it; what is pickled in that stays text.
    """

    path: Path
    content: bytes = field(repr=False)
    data: Mapping[str, Any] = field(repr=False)

    @property
    def digest(self) -> str:
        """The SHA-256 of the content, as ``run.json`` has those of files."""
        return hashlib.sha256(self.content).hexdigest()

    def stream(self) -> io.BytesIO:
        """The content, for what reads files."""
        return io.BytesIO(self.content)


def read_model(path: Path, run: Run | None = None) -> ModelFile:
    """Read a zip, which is a whole one of an agent; no agent is made of it.

    Args:
        path: the zip.
        run: the run that it is of, whose record says what it was, or None.

    Raises:
        UserError: if it is missing, unreadable, damaged, too large, or something else.
    """
    from safe_files.archives import first_look
    from safe_files.files import MAX_ARCHIVE_BYTES

    try:
        content = read_recorded(run, path, MAX_ARCHIVE_BYTES)
        return ModelFile(path, content, first_look(content))
    except FileNotFoundError:
        raise UserError(f"no such model file: {path}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no whole zip of an agent: {one_line(error)}") from error


def saved_observation(model: ModelFile) -> str | None:
    """What a library's zip says of the space that its agent observes; None if nothing plain."""
    space = model.data.get("observation_space")
    return shown_space(space) if isinstance(space, dict) else None


def shown_space(attributes: Mapping[str, Any]) -> str | None:
    """A space in words, by its attributes; None where they say nothing plain."""
    if "n" in attributes:
        return f"{attributes['n']} kinds"
    shape = attributes.get("_shape")
    return f"shape {tuple(shape)}" if shape else None


def hand_written_algorithm(model: ModelFile) -> str | None:
    """The name of the hand-written agent that a zip says it holds, or None for the library's.

    It decides which agent is meant where nobody says so, and nothing about how the zip is read.
    """
    class_name = model.data.get("algorithm")
    for name, entry in ALGORITHMS.items():
        if (
            isinstance(class_name, str)
            and entry.entry_point.endswith(f":{class_name}")
            and _is_hand_written(name)
        ):
            return name
    return None


def telling_masks(spec: TrainSpec, model: ModelFile) -> TrainSpec:
    """The spec with environments that tell action masks, where the agent in a zip goes by them.

    What the spec says of ``mask_actions`` itself holds.
    """
    algorithm, name = spec.hyperparams.algorithm, "mask_actions"
    if name in algorithm or model.data.get(name) is not True:
        return spec
    hyperparams = replace(spec.hyperparams, algorithm={**algorithm, name: True})
    saved = {**spec.saved_hyperparams, name: True}
    return replace(spec, hyperparams=hyperparams, saved_hyperparams=saved)


def _is_hand_written(algo: str) -> bool:
    """Whether zips of the agent hold JSON; where there is no class, none is loaded."""
    if ALGORITHMS[algo].family in _JSON_FAMILIES:
        return True
    from agents.common.model_files import JsonAlgorithm

    try:
        return issubclass(load_algorithm(algo), JsonAlgorithm)
    except ImportError:
        return True
