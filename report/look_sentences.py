"""How often the runs on an environment have been looked at, and with which seeds."""

from __future__ import annotations

from collections.abc import Iterable

from experiments.looks import Look, Looks
from report.seed_sentence import spans
from report.wording import enumeration


def look_sentences(looks: Looks) -> list[str]:
    """Say how many looks there were, and then of each its date, its seeds and its level."""
    if not looks.taken:
        return []
    n = len(looks.taken)
    times = {1: "once", 2: "twice"}.get(n, f"{n:,} times")
    told = [f"These runs have been looked at {times}."]
    if looks.design is not None:
        sizes = [f"{size:,}" for size in looks.design.sizes]
        told.append(f"Fixed before the first of them: looks at {enumeration(sizes)} seeds.")
    return [*told, *map(_on, looks.taken)]


def _on(look: Look) -> str:
    level = f"{100 * look.level:.2g} %"
    return f"{look.date[:10]}: {'; '.join(_seeds(look))}; claims at {level}."


def _seeds(look: Look) -> Iterable[str]:
    """Agents with the same seeds in one clause, without their names where all have them."""
    first = look.question.first_seed
    for count in sorted({*look.seeds.values()}):
        seeds = range(first, first + count)
        names = [name for name, n in look.seeds.items() if n == count]
        whose = f"{enumeration(names)}, " if len(names) < len(look.seeds) else ""
        yield f"{whose}seed{'s' if count != 1 else ''} {spans(seeds)}"
