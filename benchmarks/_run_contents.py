"""The comparable contents of files of runs and studies: without times and durations."""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

TIMES = ("seconds", "cpu_seconds")
# Also digests of files with times, the settings with the folder's name, and the process.
NOT_COMPARED = (*TIMES, "began", "date", "ended", "files", "spec", "process", "command", "packed")


def contents(logs: Path) -> dict[str, Any]:
    """The contents of a run's or a study's files without times and durations, by relative name.

    The numbers of the folders with replaced runs of a study are left out of the names.
    """
    files = sorted(path for path in logs.rglob("*") if path.is_file())
    return {_name(path.relative_to(logs)): _content(path) for path in files}


def _name(path: Path) -> str:
    return re.sub(r"/replaced/\d+/", "/replaced/", path.as_posix())


def _content(path: Path) -> Any:
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as members:
            tensors = [n for n in members.namelist() if n.endswith(".pth")]
            return [_bits(th.load(io.BytesIO(members.read(name)))) for name in tensors]
    if path.suffix == ".npz":
        return {name: array.tobytes() for name, array in np.load(path).items()}
    if path.name.endswith("monitor.csv"):
        lines = path.read_text(encoding="utf-8").splitlines()
        return [line.split(",")[:2] for line in lines[1:]]
    if path.suffix == ".json":
        return _without_times(json.loads(path.read_text(encoding="utf-8")))
    if path.suffix in (".csv", ".gz"):
        opened = gzip.open if path.suffix == ".gz" else open
        with opened(path, "rt", encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        return [{k: v for k, v in row.items() if k not in (*TIMES, "path")} for row in rows]
    if path.suffix == ".gif":
        return path.read_bytes()
    # Other files contain commands, durations and folders.
    return path.suffix


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_times(v) for k, v in value.items() if k not in NOT_COMPARED}
    return [_without_times(held) for held in value] if isinstance(value, list) else value


def _bits(value: Any) -> Any:
    if isinstance(value, th.Tensor):
        return value.detach().numpy().tobytes()
    if isinstance(value, dict):
        return [(name, _bits(held)) for name, held in value.items()]
    return [_bits(held) for held in value] if isinstance(value, list | tuple) else value
