"""What a zip says of the agent in it, without making an agent of it: only plain JSON is read."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents import ALGORITHMS, load_algorithm
from pipeline.errors import UserError, one_line
from pipeline.file_digests import RECORD, read_record
from pipeline.run_folder import Run
from pipeline.train_spec import TrainSpec

# Folders of `agents` in which no agent has a zip with a pickle: known before any is imported.
_JSON_FAMILIES = {"tabular", "bandits", "mabwiser"}

# What the library raises at zips and JSON that are damaged, encrypted, nested without end, or of a
# kind that it does not know.
_DAMAGE = (OSError, ValueError, LookupError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error)


def check_model_file(path: Path) -> None:
    """Make sure that ``path`` is a whole zip of an agent, without making any agent of it.

    Raises:
        UserError: if it is missing, unreadable, damaged, too large, or something else.
    """
    from safe_files.archives import read_members
    from safe_files.limits import MAX_ARCHIVE_BYTES
    from safe_files.regular_files import read_file

    try:
        names = read_members(read_file(path, MAX_ARCHIVE_BYTES)).keys()
    except FileNotFoundError:
        raise UserError(f"no such model file: {path}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no whole zip of an agent: {one_line(error)}") from error
    if "data" not in names or not any(name.endswith(".pth") for name in names):
        raise UserError(f"{path} is no whole zip of an agent: it lacks parts that one has")


def plain_data(path: Path) -> dict[str, Any]:
    """The JSON that a zip of any agent holds; what is pickled in it stays text."""
    from safe_files.limits import MAX_ARCHIVE_BYTES, MAX_SETTINGS_BYTES
    from safe_files.regular_files import opened

    try:
        with opened(path, MAX_ARCHIVE_BYTES) as file, zipfile.ZipFile(file) as archive:
            if archive.getinfo("data").file_size > MAX_SETTINGS_BYTES:
                raise ValueError("its settings are too large")
            data = json.loads(archive.read("data"))
    except _DAMAGE as error:
        raise UserError(f"{path} is no whole zip of an agent: {one_line(error)}") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is no whole zip of an agent: its data maps no names to values")
    return data


def saved_observation(path: Path) -> str | None:
    """What a library's zip says of the space that its agent observes; None if nothing plain."""
    space = plain_data(path).get("observation_space")
    return shown_space(space) if isinstance(space, dict) else None


def shown_space(attributes: Mapping[str, Any]) -> str | None:
    """A space in words, by its attributes; None where they say nothing plain."""
    if "n" in attributes:
        return f"{attributes['n']} kinds"
    shape = attributes.get("_shape")
    return f"shape {tuple(shape)}" if shape else None


def run_of(path: Path) -> Run | None:
    """The run folder that a model file lies in, or None if it lies elsewhere."""
    folder = path.resolve().parent
    try:
        env_name = read_record(folder / RECORD).get("env_name")
    except (OSError, UserError):
        return None
    return Run(folder, env_name) if isinstance(env_name, str) else None


def hand_written_algorithm(path: Path) -> str | None:
    """The name of the hand-written agent that a zip says it holds, or None for the library's.

    It decides which agent is meant where nobody says so, and nothing about how the zip is read.

    Raises:
        UserError: if that is damaged.
    """
    class_name = plain_data(path).get("algorithm")
    for name, entry in ALGORITHMS.items():
        if (
            isinstance(class_name, str)
            and entry.entry_point.endswith(f":{class_name}")
            and _is_hand_written(name)
        ):
            return name
    return None


def telling_masks(spec: TrainSpec, model: Path) -> TrainSpec:
    """The spec with environments that tell action masks, where the agent in a zip goes by them.

    What the spec says of ``mask_actions`` itself holds. Reads plain JSON and nothing else.

    Raises:
        UserError: if the zip is damaged.
    """
    check_model_file(model)
    algorithm, name = spec.hyperparams.algorithm, "mask_actions"
    if name in algorithm or plain_data(model).get(name) is not True:
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
