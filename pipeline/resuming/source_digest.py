"""Which sources wrote a state: what other ones make of it is nobody's training."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# What the objects of a training, and what is recorded of them, are made by.
PACKAGES = ("mdp", "envs", "agents", "snapshots", "pipeline")


@cache
def source_digest() -> str:
    """Of the sources that a training consists of, as they are when it is first asked for."""
    paths = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    lines = [
        f"{path.relative_to(ROOT).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}"
        for path in paths
    ]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
