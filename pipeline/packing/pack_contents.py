"""What a pack holds: the files of a finished run that others need, each checked and scrubbed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from pipeline.digests import FIELD, RECORD, VERSION, VERSION_FIELD, sealed
from pipeline.errors import UserError, one_line
from pipeline.files import json_text
from pipeline.models.find import read_recorded, run_in
from pipeline.module_records import COPIES
from pipeline.packing.model_card import card, results
from pipeline.packing.scrubbing import check_secrets, check_untold, record_to_tell, zip_to_tell
from pipeline.runs import FINISHED, Run
from safe_files.files import MAX_ARCHIVE_BYTES

CARD = "README.md"
STUDY_RECORD = "study.json"  # of the pack of a study, with the digests of its files
FILMS = (".mp4", ".gif")
MOST_FILM_BYTES = 64 << 20


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a pack of a run, by name.

    Args:
        folder: the run folder.

    Raises:
        UserError: if the run is not finished or damaged, or a file names a place on this machine.
    """
    run = run_in(folder)
    if not run.recorded_spec():
        raise UserError(f"{folder} does not say what was trained: it is no run of ours")
    info = run.read_info()
    if info.get("state") != FINISHED:
        raise UserError(f"{folder} is {info.get('state')}, and a pack is of a finished run")
    check_secrets(info["spec"]["hyperparams"])
    try:
        record = record_to_tell(info)
        files = dict(_files(run, record))
        files[CARD] = card(record, files.keys()).encode()
    except (TypeError, ValueError, LookupError, AttributeError) as error:  # of whatever it says
        raise UserError(f"{folder} cannot be packed: {one_line(error)}") from error
    record |= {VERSION_FIELD: VERSION, FIELD: {name: _digest(files[name]) for name in files}}
    files[RECORD] = (json_text(sealed(record), indent=2) + "\n").encode()
    check_untold(files, run)
    return files


def _files(run: Run, record: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """All files but the card and the record; of the run's, only those that its record names."""
    recorded = run.files.digests
    if recorded is None:
        raise UserError(f"{run.path} recorded no digests of its files: train again to pack it")
    spec, settings = record["spec"], run.params_path.name
    yield run.model_path.name, zip_to_tell(read_recorded(run, run.model_path, MAX_ARCHIVE_BYTES))
    for name in sorted(recorded):
        if name.startswith(f"{COPIES}/") and name.endswith(".py"):
            yield name, read_recorded(run, run.path / name, MAX_ARCHIVE_BYTES)
    yield f"{settings}/config.yml", _yaml(spec["hyperparams"])
    arguments = {
        "algo": spec["algo"],
        "env": spec["env_id"],
        "seed": spec["seed"],
        "env_kwargs": spec["hyperparams"].get("env_kwargs"),
    }
    yield f"{settings}/args.yml", _yaml(arguments)
    for name, path in (
        (f"{settings}/vecnormalize.pkl", run.vecnormalize_path),
        ("value_map.png", run.value_map_path),
        ("learning_curve.png", run.curve_path),
    ):
        if path.relative_to(run.path).as_posix() in recorded:
            yield name, read_recorded(run, path, MAX_ARCHIVE_BYTES)
    if (told := results(record)) is not None:
        yield "results.json", told.encode()
    for name in sorted(recorded):
        if Path(name).suffix in FILMS and "/" not in name:
            film = read_recorded(run, run.path / name, MOST_FILM_BYTES)
            yield f"replay{Path(name).suffix}", film
            break


def _yaml(data: dict[str, Any]) -> bytes:
    return str(yaml.safe_dump(data)).encode()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
