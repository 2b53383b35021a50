"""Numbers as text, and sentences on seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise

from rl_yardstick.experiments.plan import Seeds, TuningSeeds
from rl_yardstick.pipeline.evaluation.yardstick import bracket_mark
from rl_yardstick.verdicts import Estimate

SIGNIFICANT = 4  # digits


def number(value: float | None) -> str:
    """A figure with four significant digits, or a dash where there is none."""
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never" if value > 0 else "-∞"
    if value == 0 or abs(value) >= 10 ** (SIGNIFICANT - 1):
        return f"{value:,.0f}"
    digits = SIGNIFICANT - 1 - math.floor(math.log10(abs(value)))
    text = f"{value:.{min(max(digits, 0), SIGNIFICANT)}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def score_number(value: float | None) -> str:
    """A score, rounded down: 1 is the optimum and nothing less."""
    if value is None or math.isnan(value):
        return "-"
    digits = 10.0**SIGNIFICANT
    return number(math.floor(value * digits + 1e-6) / digits)


Format = Callable[[float | None], str]


def interval(estimate: Estimate, as_text: Format = number) -> str:
    """A mean with its interval in brackets, or with the range of few runs in parentheses.

    The mean alone where all runs are equal.
    """
    point, low, high = map(as_text, (estimate.point, estimate.low, estimate.high))
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return point
    return f"{point} ({low} to {high})" if estimate.is_range else f"{point} [{low}, {high}]"


def interval_alone(estimate: Estimate, as_text: Format = number) -> str:
    """The interval or range of a mean, empty where all runs are equal."""
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return ""
    return f"{as_text(estimate.low)} to {as_text(estimate.high)}"


def optimum_words(optimum: float | None, at_least: float | None, is_proven: bool = True) -> str:
    """The optimum, or both ends of its bracket, with three decimals where they look equal."""
    if at_least is None or optimum is None:
        return number(optimum)
    ends = [number(at_least), number(optimum)]
    if ends[0] == ends[1]:
        ends = [f"{at_least:,.3f}", f"{optimum:,.3f}"]
    return f"{ends[0]} to {ends[1]} {bracket_mark(is_proven)}"


def scale_words(full_optimum: float | None, measured_by: str | None) -> str:
    """Under partial observability: what the optimum is based on, and that of the full state."""
    if full_optimum is None:
        return ""
    goes_by = "all that it has observed" if measured_by == "memory" else "what it observes now"
    return (
        f"observations hide the state: the optimum, the same for all agents, is that of an agent "
        f"that acts on {goes_by}; one that saw the state could have {number(full_optimum)}"
    )


def enumeration(words: Sequence[str]) -> str:
    """Words joined by commas, the last by "and"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 2 else words)


def seeds(*counts: int) -> str:
    """A number of seeds, or a range of numbers."""
    least, most = min(counts), max(counts)
    return f"{'' if least == most else f'{least:,} to '}{most:,} seed{'s' if most != 1 else ''}"


# On which seeds the settings of a study were tuned, in one line.

MOST_NAMES = 6


def seed_sentence(seeds: range, tuning: TuningSeeds) -> str:
    """Say which of the seeds of a study the settings of its agents were tuned on."""
    these = _these(seeds)
    parts = [
        *_tuned(seeds, tuning.shipped, "the shipped settings of"),
        *_tuned(seeds, tuning.files, "the settings in"),
    ]
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
    """One clause for each set of seeds: whose settings were tuned on them."""
    groups: dict[Seeds, list[str]] = {}
    for name, shared in found.items():
        if shared:
            groups.setdefault(shared, []).append(name)
    return [
        f"{whose} {_names(names)} were tuned on "
        + (f"{spans(shared)} of these" if len(shared) < len(seeds) else _these(seeds))
        for shared, names in groups.items()
    ]


def _these(seeds: range) -> str:
    return "these" if len(seeds) > 1 else "it"


def _names(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMES
    return enumeration([*names[:MOST_NAMES], f"{more:,} more"] if more > 0 else names)


def spans(numbers: Iterable[int]) -> str:
    """Integers as text, with consecutive ones as a span: "0 to 4, 7"."""
    ordered = sorted(numbers)
    ends = [one for one, two in pairwise(ordered) if two != one + 1] + ordered[-1:]
    starts = ordered[:1] + [two for one, two in pairwise(ordered) if two != one + 1]
    pairs = zip(starts, ends, strict=True)
    return ", ".join(f"{low} to {high}" if low != high else str(low) for low, high in pairs)
