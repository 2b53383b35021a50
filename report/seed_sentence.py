"""On which seeds the settings of a study were tuned, in one line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

from experiments.plan import Seeds, TuningSeeds
from report.wording import enumeration

MOST_NAMES = 6


def seed_sentence(seeds: range, tuning: TuningSeeds) -> str:
    """Say which of the seeds that agents are judged on their settings were tuned on.

    Args:
        seeds: of the study.
        tuning: what is known of its settings.
    """
    parts = [
        *_tuned(seeds, tuning.shipped, "the shipped settings of"),
        *_tuned(seeds, tuning.files, "the settings in"),
    ]
    these = "these" if len(seeds) > 1 else "it"
    if tuning.elsewhere:
        names = _names(tuning.elsewhere)
        parts.append(f"the settings of {names} were tuned with other arguments of the environment")
    if not parts and not tuning.unknown:
        parts = [f"nothing was tuned on {these}"]
    elif not parts and (tuning.shipped or tuning.files):
        parts = [f"nothing is known to have been tuned on {these}"]
    if tuning.unknown:
        names = _names(tuning.unknown)
        parts.append(f"what the study's own settings of {names} were tuned on is not known")
    return f"{'Seeds' if len(seeds) > 1 else 'Seed'} {spans(seeds)}: {'; '.join(parts)}."


def _tuned(seeds: range, found: Mapping[str, Seeds], whose: str) -> list[str]:
    """Those that were tuned on the same of the seeds in one clause."""
    groups: dict[Seeds, list[str]] = {}
    for name, shared in found.items():
        if shared:
            groups.setdefault(shared, []).append(name)
    return [
        f"{whose} {_names(names)} were tuned on {_which(seeds, shared)}"
        for shared, names in groups.items()
    ]


def _which(seeds: range, shared: Seeds) -> str:
    if len(shared) == len(seeds):
        return "these" if len(seeds) > 1 else "it"
    return f"{spans(shared)} of these"


def _names(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMES
    return enumeration([*names[:MOST_NAMES], f"{more:,} more"] if more > 0 else names)


def spans(numbers: Iterable[int]) -> str:
    """Whole numbers, those that follow each other as a span: "0 to 4, 7"."""
    ordered = sorted(numbers)
    ends = [one for one, two in pairwise(ordered) if two != one + 1] + ordered[-1:]
    starts = ordered[:1] + [two for one, two in pairwise(ordered) if two != one + 1]
    pairs = zip(starts, ends, strict=True)
    return ", ".join(f"{low} to {high}" if low != high else str(low) for low, high in pairs)
