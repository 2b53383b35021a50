"""The sources of packages, and a digest of their content."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

# The folder of `rl_yardstick`, with all packages.
ROOT = Path(__file__).resolve().parent.parent


def source_digest(packages: Iterable[str], *more: str) -> str:
    """A digest of every source's path and content, and of further texts: 16 hexadecimal digits."""
    paths = sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))
    found = hashlib.sha256("\n".join(more).encode())
    for path in paths:
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        found.update(f"{path.relative_to(ROOT).as_posix()} {content}\n".encode())
    return found.hexdigest()[:16]
