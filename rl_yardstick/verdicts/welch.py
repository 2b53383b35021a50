"""The tests behind verdicts: Welch's t for one pair of agents, and Holm's correction over pairs."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from rl_yardstick.verdicts.estimates import (
    SAME,
    UNBOUNDED,
    Bounds,
    Floats,
    finite,
    mean_and_variance,
    t_reach,
)

MOST_NEEDED = 10_000  # the largest number of seeds to propose
K = TypeVar("K", bound=Hashable)


class Sample(NamedTuple):
    """The runs of one agent; those of an agent without chance count as infinitely many."""

    n: float
    mean: float
    variance: float

    def interval(self, level: float, ends: Bounds) -> Bounds:
        """Student's t interval of the mean, cut at the bounds."""
        if self.n < 2:
            return ends
        reach = t_reach(self.n, self.variance, level)
        return max(self.mean - reach, ends[0]), min(self.mean + reach, ends[1])


class Difference(NamedTuple):
    """The difference of two means, with its standard error and degrees of freedom."""

    n: float  # the fewer runs of the two
    apart: float
    error: float
    freedom: float
    samples: tuple[Sample, Sample]


def sample(runs: ArrayLike, *, is_certain: bool = False) -> Sample:
    """The sample of an agent's runs; non-finite ones are missing."""
    known = finite(runs)
    mean, variance = mean_and_variance(known)
    return Sample(np.inf if is_certain and len(known) else len(known), mean, variance)


def welch(one: Sample, two: Sample) -> Difference:
    """The difference of two means whose variances may differ: Welch (1947)."""
    n, apart = min(one.n, two.n), one.mean - two.mean
    if n < 2:
        return Difference(n, apart, np.nan, np.nan, (one, two))
    parts = [(each.variance / each.n, each.n - 1) for each in (one, two)]
    total = sum(part for part, _ in parts)
    freedom = one.n + two.n - 2
    if total > 0:
        freedom = total**2 / sum(part**2 / free for part, free in parts if part > 0)
    return Difference(n, apart, total**0.5, freedom, (one, two))


def student(first: ArrayLike, second: ArrayLike) -> Difference:
    """The same where runs at one place share their randomness: Student's paired t."""
    x, y = np.asarray(first, np.float64), np.asarray(second, np.float64)
    n_both = min(len(x), len(y))
    there = np.isfinite(x[:n_both]) & np.isfinite(y[:n_both])
    x, y = x[:n_both][there], y[:n_both][there]
    apart, variance = mean_and_variance(x - y)
    error = (variance / len(x)) ** 0.5 if len(x) > 1 else np.nan
    return Difference(len(x), apart, error, len(x) - 1, (sample(x), sample(y)))


def lowest_p(n: ArrayLike) -> Floats:
    """The lowest one-sided p-value from n runs of both agents, elementwise; n is at least 2.

    Equal runs must not prove everything: as if one run in 5 (n + 1) scored like the other agent.
    """
    runs = np.asarray(n, np.float64)
    return np.asarray(special.stdtr(2 * runs - 2, -np.sqrt(2.5 * runs * (runs + 1))))


def p_above(found: Difference, least: float, sign: float = 1.0) -> float:
    """The p-value of "the first mean is ahead by more than ``least``"; -1 swaps the agents."""
    if found.n < 2:
        return 1.0
    apart = sign * found.apart - least
    if abs(apart) <= SAME * max(1.0, *(abs(each.mean) for each in found.samples)):
        return 0.5
    p = float(apart < 0)
    if found.error > 0:
        p = float(special.stdtr(found.freedom, -apart / found.error))
    return max(p, float(lowest_p(found.n)))


def p_different(found: Difference) -> float:
    """The p-value of "the means differ"."""
    return 2 * min(p_above(found, 0.0), p_above(found, 0.0, -1))


def p_tied(found: Difference, margin: float) -> float:
    """The p-value of "the means differ by less than the margin": Schuirmann (1987)."""
    if margin == 0:
        return 1.0
    return max(p_above(found, -margin), p_above(found, -margin, -1))


def holm(p_values: Mapping[K, float]) -> dict[K, float]:
    """P-values corrected by Holm's procedure (1979): those up to a level hold together."""
    corrected, highest = {}, 0.0
    for k, (key, p) in enumerate(sorted(p_values.items(), key=lambda item: item[1])):
        highest = max(highest, min(1.0, p * (len(p_values) - k)))
        corrected[key] = highest
    return corrected


def difference_interval(found: Difference, level: float, ends: Bounds) -> Bounds:
    """The differences that the test does not reject at a level, cut at what is possible."""
    # Means outside of the bounds show that these are wrong.
    means = [each.mean for each in found.samples if each.n]
    ends = min(ends[0], *means, np.inf), max(ends[1], *means, -np.inf)
    low, high = UNBOUNDED
    if found.n > 1 and 2 * lowest_p(found.n) <= level:
        reach = float(special.stdtrit(found.freedom, 1 - level / 2) * found.error)
        low, high = found.apart - reach, found.apart + reach
    (a_low, a_high), (b_low, b_high) = (each.interval(level, ends) for each in found.samples)
    low, high = max(low, a_low - ends[1], ends[0] - b_high), min(high, a_high - ends[0])
    return low, min(high, ends[1] - b_low)


def seeds_needed(found: Difference, levels: tuple[float, float], margin: float) -> int | None:
    """How many seeds of each would decide a pair, if further runs have these means and variances.

    To one per cent; None for fewer than two runs, or where more than 10,000 would. ``levels`` are
    those of this pair, for a difference and for a tie.
    """
    if found.n < 2 or np.isinf(found.n):
        return None
    n = np.unique(np.geomspace(found.n + 1, MOST_NEEDED, 700).astype(int)).astype(np.float64)
    error = found.error * np.sqrt(found.n / n)
    freedom = found.freedom * (n - 1) / (found.n - 1)
    apart, floor = abs(found.apart), lowest_p(n)
    with np.errstate(divide="ignore", invalid="ignore"):
        different = np.maximum(special.stdtr(freedom, -apart / error), floor)
        tied = np.maximum(special.stdtr(freedom, (apart - margin) / error), floor)
    enough = ((2 * different <= levels[0]) & (apart > 0)) | (tied <= levels[1]) & (apart < margin)
    return int(n[enough.argmax()]) if enough.any() else None
