"""Which sources something was made by: what other ones make of it may be something else."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# What the objects of a training, and what is recorded of them, are made by.
OF_TRAINING = ("safe_files", "snapshots", "mdp", "envs", "agents", "pipeline")


@cache
def source_digest(*more: str) -> str:
    """Of the packages `OF_TRAINING` and ``more``, as they are when it is first asked for."""
    packages = sorted({*OF_TRAINING, *more})
    lines = [
        f"{path.relative_to(ROOT).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}"
        for package in packages
        for path in sorted((ROOT / package).rglob("*.py"))
    ]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
