"""Whether the runs of a study were done with the same versions of the libraries."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any


def mixed_versions(infos: Iterable[Mapping[str, Any]]) -> str:
    """Which versions differ between runs, in a line; empty where none does.

    Args:
        infos: contents of ``run.json``, see `pipeline.runs.Run.read_info`.
    """
    counts: dict[str, Counter[str]] = {}
    for info in infos:
        for package, version in info.get("versions", {}).items():
            counts.setdefault(package, Counter())[version] += info.get("n_runs", 1)
    mixed = [
        f"{package} {', '.join(_counted(*item) for item in sorted(found.items()))}"
        for package, found in counts.items()
        if len(found) > 1
    ]
    return f"runs were done with different versions: {'; '.join(mixed)}" if mixed else ""


def _counted(version: str, n_runs: int) -> str:
    return f"{version} ({n_runs} run{'' if n_runs == 1 else 's'})"
