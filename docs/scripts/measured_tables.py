"""Results of benchmarks, from docs/measured, as tables and sentences of pages."""

from __future__ import annotations

import json
from pathlib import Path

MEASURED = Path(__file__).resolve().parents[1] / "measured"


def timings_block(name: str) -> str:
    """A row for each contender, with its speed relative to the first contender of its work.

    Args:
        name: of the published file in docs/measured.
    """
    found = json.loads((MEASURED / name).read_text(encoding="utf-8"))
    lines = [f"| | contender | {found['unit']} | times as fast |", "|---|---|---|---|"]
    for work, contenders in found["rows"].items():
        anchor = next(iter(contenders.values()))
        for k, (contender, value) in enumerate(contenders.items()):
            ratio = value / anchor if found["is_speed"] else anchor / value
            told = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
            lines.append(
                f"| {'' if k else work} | {contender} | {told} | {f'{ratio:.3g}' if k else ''} |"
            )
    rounds = "one round" if found["rounds"] == 1 else f"medians of {found['rounds']} rounds"
    lines.append(
        f"\n{found['day']}, commit {found['commit']}, {rounds}, Python {found['python']}, "
        f"{found['cores']} cores with a load of {found['load']}."
    )
    return "\n".join(lines) + "\n"


def measured_block(name: str) -> str:
    """The sentences and tables that `publish` has written.

    Args:
        name: of the file in docs/measured.
    """
    parts = json.loads((MEASURED / name).read_text(encoding="utf-8"))
    return "\n\n".join(part if isinstance(part, str) else _table(part) for part in parts) + "\n"


def _table(rows: list[list[str]]) -> str:
    heading, *body = rows
    lines = [heading, ["---"] * len(heading), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def publish(path: Path, text: str) -> None:
    """Write Markdown of paragraphs and tables as JSON, with each row of a table on a line."""
    parts: list[str | list[list[str]]] = []
    for block in filter(None, (block.strip() for block in text.split("\n\n"))):
        if block.startswith("|"):
            cells = [line.strip()[1:-1].split("|") for line in block.splitlines()]
            parts.append([[cell.strip() for cell in row] for k, row in enumerate(cells) if k != 1])
        else:
            parts.append(" ".join(block.split()))
    written = [
        json.dumps(part, ensure_ascii=False)
        if isinstance(part, str)
        else "[\n" + ",\n".join(json.dumps(row, ensure_ascii=False) for row in part) + "\n]"
        for part in parts
    ]
    path.write_text("[\n" + ",\n".join(written) + "\n]\n", encoding="utf-8")
