"""Claims about expected scores: means over all runs, with the runs that fail.

No test on observed runs keeps its error rate for the mean: an agent that fails in one run of twenty
has mostly not failed in ten. Scores, however, are bounded by 0 and 1. So an unconditional claim
passes two tests that compare the observed runs, and two guards that allow for unobserved runs.
Where the guards do not pass, the claim is conditional: it assumes that few further runs lie outside
the observed range. docs/statistics.md gives the error rates of both kinds of claims.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, count
from math import comb
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

from verdicts.resampling import Floats

Verdict = Literal["better", "worse", "equivalent", "undecided"]
Exact = tuple[bool, bool]  # of two agents, whether each is deterministic

# With fewer runs of an agent nothing is claimed about its mean.
FEWEST_SEEDS = 5
N_SPLITS = 4000  # splits of a permutation test; all of them where there are fewer
# From this many scores of both agents on, Welch's test gives the same result as permutations.
MOST_PERMUTED = 400
N_SPACINGS = 4000
# More sorted scores than this are grouped with their neighbours, at the lowest score of the group.
MOST_SPACINGS = 2000
SAME = 1e-12  # means closer than this are equal
ROUNDED = 1e-9  # scores this close to an end count as the end, and such differences as 0


def opposite(verdict: Verdict) -> Verdict:
    """The verdict from the second agent's point of view."""
    turned: dict[Verdict, Verdict] = {"better": "worse", "worse": "better"}
    return turned.get(verdict, verdict)


@dataclass(frozen=True)
class MeanVerdict:
    """A verdict on the means of two agents."""

    verdict: Verdict  #: the verdict on the first of the two
    #: Whether it holds only as long as few further runs lie outside the observed range.
    is_conditional: bool = False

    def swapped(self) -> MeanVerdict:
        """The same verdict from the second agent's point of view."""
        return replace(self, verdict=opposite(self.verdict))


@dataclass(frozen=True)
class MeanDifference:
    """How far one agent is ahead of another on average, in scores between 0 and 1."""

    point: float  #: the difference of the means of the runs
    low: float  #: lower end for every distribution of scores in [0, 1]; agrees with the verdict
    high: float  #: upper end, likewise
    seen_low: float  #: lower end if further runs lie within the observed range
    seen_high: float  #: upper end, likewise
    #: The smallest share of further runs outside the observed range (the leading agent's below, the
    #: other's above) that may cancel the observed lead; 0 without a lead.
    most_outside: float = 0.0

    def swapped(self) -> MeanDifference:
        """The same difference from the second agent's point of view."""
        return replace(
            self,
            point=-self.point,
            low=-self.high,
            high=-self.low,
            seen_low=-self.seen_high,
            seen_high=-self.seen_low,
        )


# Tests on the observed runs.


def welch_p_value(first: Floats, second: Floats, *, cautious: bool = False) -> float:
    """The p-value of "the first mean is higher", where variances may differ.

    ``cautious`` limits the degrees of freedom to those of the smaller sample.

    Source: Welch (1947), "The generalization of 'Student's' problem when several different
    population variances are involved", Biometrika 34.
    """
    ahead = float(first.mean() - second.mean())
    if ahead <= SAME:
        return 1.0
    parts = first.var(ddof=1) / len(first), second.var(ddof=1) / len(second)
    spread = float(np.sqrt(sum(parts)))
    if spread <= SAME:
        return 0.0
    shares = parts[0] / spread**2, parts[1] / spread**2
    freedom = 1 / (shares[0] ** 2 / (len(first) - 1) + shares[1] ** 2 / (len(second) - 1))
    if cautious:
        freedom = min(len(first), len(second)) - 1
    return float(stats.t.sf(ahead / spread, freedom))


def permutation_p_value(first: Floats, second: Floats) -> float:
    """The same p-value, from all or many permutations of the scores, with Welch's statistic.

    Source: Janssen (1997), "Studentized permutation tests for non-i.i.d. hypotheses", Statistics
    and Probability Letters 36; Chung and Romano (2013), "Exact and asymptotically robust
    permutation tests", Annals of Statistics 41.
    """
    n, m = len(first), len(second)
    if first.mean() - second.mean() <= SAME:
        return 1.0
    pooled = np.concatenate([first, second])
    pooled = pooled - pooled.mean()
    taken = _splits(n, m)
    sums, squares = taken @ pooled, taken @ pooled**2
    total = float((pooled**2).sum())
    ahead = sums / n + sums / m
    variances = [
        np.maximum(each / size - (sums / size) ** 2, 0) / (size - 1)
        for each, size in ((squares, n), (total - squares, m))
    ]
    statistic = ahead / np.sqrt(variances[0] + variances[1] + 1e-12 * total / (n + m))
    found = float((statistic >= statistic[0] * (1 - 1e-9)).mean())
    if len(taken) < N_SPLITS:
        return found
    # Sampled splits cannot show p-values below 1 / N_SPLITS.
    return min(found, welch_p_value(first, second, cautious=True))


def paired_p_value(first: Floats, second: Floats) -> float:
    """The same p-value for paired runs: paired t-test and, if all can be tried, sign flips.

    Source: Student (1908); Fisher (1935), "The design of experiments", section 21.
    """
    apart = first - second
    mean = float(apart.mean())
    if mean <= SAME:
        return 1.0
    spread = float(apart.std(ddof=1)) / len(apart) ** 0.5
    by_t = 0.0 if spread <= SAME else float(stats.t.sf(mean / spread, len(apart) - 1))
    if 2 ** len(apart) >= N_SPLITS:  # sampled flips cannot show p-values below 1 / N_SPLITS
        return by_t
    sums = _signs(len(apart)) @ apart
    return max(by_t, float((sums >= sums[0] * (1 - 1e-9)).mean()))


@lru_cache(maxsize=32)
def _splits(n: int, m: int) -> Floats:
    """Which scores go to the first agent, shape (splits, n + m); the first is the real split."""
    if comb(n + m, n) < N_SPLITS:
        chosen = np.array(list(combinations(range(n + m), n)))
    else:
        rng = np.random.default_rng(0)
        drawn = [rng.permutation(n + m)[:n] for _ in range(N_SPLITS - 1)]
        chosen = np.array([np.arange(n), *drawn])
    taken = np.zeros((len(chosen), n + m))
    taken[np.arange(len(chosen))[:, None], chosen] = 1
    return taken


@lru_cache(maxsize=32)
def _signs(n: int) -> Floats:
    """All ways to flip the signs of n differences, shape (flips, n); the first flips none."""
    return np.where((np.arange(2**n)[:, None] >> np.arange(n)) & 1, -1.0, 1.0)


# Guards that allow for unobserved runs.


def lowest_means(scores: Floats, *, exact: bool = False) -> Floats:
    """Simulated lower bounds on the mean of scores in [0, 1]; ascending.

    The share of these at or below a value is the p-value of "the expected score is above it".
    ``exact`` scores are all equal, and are their own mean.

    Source: Learned-Miller and Thomas (2019), "A new confidence interval for the mean of a bounded
    random variable", arXiv:1905.06208.
    """
    if exact:
        return scores[:1]
    return np.sort(np.sort(scores)[_starts(len(scores))] @ _spacings(len(scores)))


def _starts(n: int) -> NDArray[np.int64]:
    """The index at which each group of n sorted scores begins; groups of one if they are few."""
    n_groups = min(n, MOST_SPACINGS)
    return np.arange(n_groups) * n // max(n_groups, 1)


@lru_cache(maxsize=32)
def _spacings(n: int) -> Floats:
    """Gaps above each of n sorted uniform numbers, summed by group, shape (groups, draws)."""
    if n > MOST_SPACINGS:  # sums of gaps are gamma variates, divided by the sum of all
        sizes = np.diff(_starts(n), append=n)
        gaps = np.random.default_rng(0).gamma([1, *sizes], size=(N_SPACINGS, len(sizes) + 1))
        return np.asarray((gaps[:, 1:] / gaps.sum(axis=1, keepdims=True)).T.copy())
    uniform = np.sort(np.random.default_rng(0).random((N_SPACINGS, n)), axis=1)
    return np.diff(np.hstack([uniform, np.ones((N_SPACINGS, 1))]), axis=1).T.copy()


def mean_interval(scores: ArrayLike, level: float, *, exact: bool = False) -> tuple[float, float]:
    """The interval of an agent's expected score, for every distribution on [0, 1].

    Args:
        scores: of the agent's runs, between 0 and 1, shape (n,), with n at least 1.
        level: one minus the confidence.
        exact: whether the agent is deterministic.
    """
    values = np.asarray(scores, np.float64)
    low = float(np.quantile(lowest_means(values, exact=exact), level / 2))
    return low, 1 - float(np.quantile(lowest_means(1 - values, exact=exact), level / 2))


# Tests and guards together.


def seen_p_value(
    first: Floats, second: Floats, *, paired: bool = False, enough: float = 1.0
) -> float:
    """The p-value of "the first mean is higher", from the observed runs.

    A p-value above ``enough`` may be too low, but its true value is above ``enough`` as well.
    """
    if paired:
        return paired_p_value(first, second)
    by_t = welch_p_value(first, second)
    if by_t > enough or by_t == 1 or len(first) + len(second) >= MOST_PERMUTED:
        return by_t
    return max(by_t, permutation_p_value(first, second))


def ahead_on_average(
    first: Floats,
    second: Floats,
    *,
    paired: bool = False,
    exact: Exact = (False, False),
    enough: float = 1.0,
) -> float:
    """The p-value of "the first expected score is higher", for every distribution on [0, 1].

    A p-value above ``enough`` may be too low, but its true value is above ``enough`` as well.
    """
    if _is_at_an_end(first, second, exact):
        return 0.0
    seen = seen_p_value(first, second, paired=paired, enough=enough)
    if seen > enough:
        return seen
    guards = (
        float((lowest_means(first, exact=exact[0]) <= second.mean()).mean()),
        float((1 - lowest_means(1 - second, exact=exact[1]) >= first.mean()).mean()),
    )
    return max(seen, *guards)


def _is_at_an_end(first: Floats, second: Floats, exact: Exact) -> bool:
    """Whether a deterministic agent at an end of the scale proves that the first mean is higher.

    The first always scores 1 and the second once less, or the second always 0 and the first more.
    """
    has_most = exact[0] and first[0] >= 1 - SAME and bool((second < 1 - ROUNDED).any())
    return has_most or (exact[1] and second[0] <= SAME and bool((first > ROUNDED).any()))


def judge_means(
    first: ArrayLike,
    second: ArrayLike,
    level: float,
    *,
    margin: float = 0.0,
    paired: bool = False,
    exact: Exact = (False, False),
) -> MeanVerdict:
    """Say which of two agents scores more on average.

    Equivalence is tested first: within the margin a difference does not matter, however certain.

    Args:
        first: scores of the first agent's runs, between 0 and 1, shape (n,), finite.
        second: likewise, shape (m,); of the same seeds in the same order where ``paired``.
        level: the error rate of the verdict, on both sides together.
        margin: the largest difference that does not matter.
        paired: whether runs of one seed share their randomness.
        exact: of each agent, whether it is deterministic.
    """
    x, y = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if min(len(x), len(y)) < FEWEST_SEEDS:
        return MeanVerdict("undecided")
    means = float(x.mean()), float(y.mean())
    is_known = _is_at_an_end(x, y, exact), _is_at_an_end(y, x, exact[::-1])

    def seen(lead: float) -> bool:
        """Whether the first is ahead of the second by more than ``lead``."""
        return seen_p_value(x - lead, y, paired=paired, enough=level / 2) <= level / 2

    def seen_behind(lead: float) -> bool:
        return seen_p_value(y - lead, x, paired=paired, enough=level / 2) <= level / 2

    said: Verdict = "undecided"
    if margin > 0 and seen(-margin) and seen_behind(-margin):
        said = "equivalent"
    elif is_known[0] or seen(0.0):
        said = "better"
    elif is_known[1] or seen_behind(0.0):
        said = "worse"
    if said == "undecided":
        return MeanVerdict(said)
    low, high = _guarded(x, y, level, exact)
    is_sure = {
        "equivalent": -margin < low and high < margin,
        "better": low > ROUNDED or is_known[0],
        "worse": high < -ROUNDED or is_known[1],
    }[said]
    if said == "equivalent" and not is_sure and (low > ROUNDED or high < -ROUNDED):
        # The guards show a difference, though a small one: no further runs could reverse it.
        return MeanVerdict("better" if means[0] > means[1] else "worse")
    return MeanVerdict(said, is_conditional=not is_sure)


def compare_means(
    first: ArrayLike,
    second: ArrayLike,
    level: float,
    *,
    paired: bool = False,
    exact: Exact = (False, False),
) -> MeanDifference:
    """How far one agent is ahead of another on average: the intervals of `judge_means`.

    The intervals contain what the tests do not reject at this level. Arguments as there.
    """
    x, y = np.asarray(first, np.float64), np.asarray(second, np.float64)
    apart = float(x.mean() - y.mean()) if min(len(x), len(y)) else np.nan
    if min(len(x), len(y)) < FEWEST_SEEDS:
        return MeanDifference(apart, -1.0, 1.0, -1.0, 1.0)
    seen_low, seen_high = _seen_low(x, y, level / 2, paired), -_seen_low(y, x, level / 2, paired)
    guarded = _guarded(x, y, level, exact)
    # This share of runs at the far ends would cancel the observed lead.
    outside = max(seen_low, -seen_high, 0.0) / (1 + abs(apart))
    low, high = min(seen_low, guarded[0]), max(seen_high, guarded[1])
    return MeanDifference(apart, low, high, seen_low, seen_high, outside)


def _guarded(first: Floats, second: Floats, level: float, exact: Exact) -> tuple[float, float]:
    """The interval of the difference by the guards."""
    x_low, x_high = mean_interval(first, level, exact=exact[0])
    y_low, y_high = mean_interval(second, level, exact=exact[1])
    x, y = float(first.mean()), float(second.mean())
    return min(x_low - y, x - y_high), max(x_high - y, x - y_low)


def _seen_low(first: Floats, second: Floats, level: float, paired: bool) -> float:
    """The largest lead that the observed runs show; -1, the lowest possible, if they show none."""
    ahead = float(first.mean() - second.mean())

    def excess(lead: float) -> float:
        return seen_p_value(first - lead, second, paired=paired) - level

    # If the runs do not even show a lead above -2, there are too few splits to show anything.
    if excess(-2.0) > 0:
        return -1.0
    if excess(ahead - 2 * SAME) <= 0:
        return ahead
    return max(float(optimize.bisect(excess, -2.0, ahead, xtol=1e-5)), -1.0)


# Who is best.


def rank_by_mean(
    scores: Sequence[Floats],
    level: float,
    *,
    paired: bool = False,
    exact: Sequence[bool] = (),
    seen_only: bool = False,
) -> int:
    """How many agents, from the first on, are each shown to be ahead of all that follow.

    The agent with the highest mean is tested against every other, at half of the level: that it
    was selected by its mean needs no further correction. Only if it is ahead of all of them is the
    second tested against those behind it, and so on.

    Args:
        scores: by agent, the highest mean first, between 0 and 1, shape (n_runs,) each.
        level: the share of studies in which any of these claims may be wrong.
        paired: whether runs of one seed share their randomness.
        exact: by agent, whether it is deterministic.
        seen_only: whether the claims are conditional: few further runs lie outside the observed
            range.

    Source: Gutmann and Maymin (1987), "Is the selected population the best?", Annals of Statistics
    15; Hung and Fithian (2019), "Rank verification for exponential families", Annals of Statistics
    47.
    """
    known = [*exact, *[False] * len(scores)]
    for place, first in enumerate(scores):
        for other in range(place + 1, len(scores)):
            if min(len(first), len(scores[other])) < FEWEST_SEEDS:
                return place
            both, second = (known[place], known[other]), scores[other]
            if seen_only and not _is_at_an_end(first, second, both):
                p_value = seen_p_value(first, second, paired=paired, enough=level / 2)
            else:
                p_value = ahead_on_average(
                    first, second, paired=paired, exact=both, enough=level / 2
                )
            if p_value > level / 2 and not (all(both) and first[0] > second[0]):
                return place
    return max(len(scores) - 1, 0)


# The largest number of seeds to recommend: nobody runs more.
MOST_SEEDS = 10_000


def seeds_needed(
    first: Floats, second: Floats, level: float, margin: float = 0.0, power: float = 0.8
) -> int | None:
    """About how many runs of each agent show who is ahead, if further runs are like the observed.

    Args:
        first: scores, shape (n,), at least 2.
        second: likewise.
        level: the two-sided error rate of the verdict.
        margin: the margin of equivalence.
        power: the probability of a verdict.

    Returns:
        The number, at least ``FEWEST_SEEDS``; None beyond ``MOST_SEEDS``.
    """
    apart = abs(float(first.mean() - second.mean()))
    reach = max(apart, margin - apart)
    if reach <= SAME:
        return None
    variance = float(first.var(ddof=1) + second.var(ddof=1))
    steps = float(stats.norm.isf(level / 2) + stats.norm.ppf(power))
    needed = math.ceil(steps**2 * variance / reach**2) + 1
    return max(needed, fewest_for(level)) if needed <= MOST_SEEDS else None


def fewest_for(level: float) -> int:
    """The fewest runs of each of two agents with which permutations can reach a level."""
    return next(n for n in count(FEWEST_SEEDS) if comb(2 * n, n) * level >= 2)
