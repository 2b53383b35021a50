"""Tables of what `benchmarks/timing.py` has measured, for pages."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def timings_block(path: str) -> str:
    """A row for each contender, with how many times as fast as the first of its work it is.

    Args:
        path: of the file that was published, from the root of the repository.
    """
    found = json.loads((ROOT / path).read_text(encoding="utf-8"))
    lines = [f"| | contender | {found['unit']} | times as fast |", "|---|---|---|---|"]
    for work, contenders in found["rows"].items():
        anchor = next(iter(contenders.values()))
        for k, (name, value) in enumerate(contenders.items()):
            ratio = value / anchor if found["is_speed"] else anchor / value
            told = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
            lines.append(
                f"| {'' if k else work} | {name} | {told} | {f'{ratio:.3g}' if k else ''} |"
            )
    rounds = "one round" if found["rounds"] == 1 else f"medians of {found['rounds']} rounds"
    lines.append(
        f"\n{found['day']}, commit {found['commit']}, {rounds}, Python {found['python']}, "
        f"{found['cores']} cores with a load of {found['load']}."
    )
    return "\n".join(lines) + "\n"
