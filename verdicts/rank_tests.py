"""Which of two agents is ahead: rank tests, paired differences, typical runs."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy import special, stats

from verdicts.resampling import Estimate, Floats, check_confidence

# Paired differences between two agents.

# Exact returns of two policies that are equally good can differ in their last bits.
SAME = 1e-12


def differences(first: Floats, second: Floats) -> Floats:
    """``first`` - ``second``, exactly 0 where they agree to twelve digits."""
    with np.errstate(invalid="ignore"):  # two infinite scores are equal
        apart = first - second
        same = np.abs(apart) <= SAME * np.maximum(np.abs(first), np.abs(second))
    return np.where(same | (first == second), 0.0, apart)


def same_shape(first: Floats, second: Floats) -> None:
    """Refuse scores that do not pair up."""
    if first.shape != second.shape:
        raise ValueError(
            f"scores of shapes {first.shape} and {second.shape} do not pair up: give both agents "
            "the same seeds, and NaN for a run that failed"
        )


def paired_difference(first: ArrayLike, second: ArrayLike, confidence: float = 0.95) -> Estimate:
    """The mean of ``first`` - ``second`` over seeds, with the paired t interval.

    In simulations with 5 to 30 seeds the 95 % interval covered the mean in 93 to 97 % of the cases
    where differences are symmetric or two-peaked, and in 82 to 94 % where they are strongly skewed
    (exponential, log-normal). BCa covered 80 to 95 % and 75 to 92 %, and least with 5 seeds. If
    failures are too rare to be observed, no interval covers the mean.

    Args:
        first: shape (n_seeds,).
        second: likewise, the same seeds at the same places. A seed counts where both are finite.
        confidence: the confidence level of the interval.

    Returns:
        The estimate, without interval for fewer than two seeds. Where all differences are equal the
        interval is the point.

    Raises:
        ValueError: for arguments out of range, or shapes that do not pair up.
    """
    check_confidence(confidence)
    x, y = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    same_shape(x, y)
    if x.ndim != 1:
        raise ValueError(f"scores to be paired have shape {x.shape}, they must have (n_seeds,)")
    both = np.isfinite(x) & np.isfinite(y)
    apart = differences(x[both], y[both])
    n = len(apart)
    if n == 0:
        return Estimate(np.nan, np.nan, np.nan, 0, x.size)
    # Relative to the first, so that equal differences have a spread of exactly 0.
    offsets = apart - apart[0]
    mean, half = float(apart[0] + offsets.mean()), np.nan
    if n > 1:
        half = float(stats.t.isf((1 - confidence) / 2, n - 1) * offsets.std(ddof=1) / np.sqrt(n))
    return Estimate(mean, mean - half, mean + half, n, x.size - n)


def holm(p_values: ArrayLike) -> Floats:
    """P-values with Holm's correction: those up to a level hold jointly at this error rate.

    Args:
        p_values: shape (n_tests,). NaN stands for a test that could not be made, and stays.

    Returns:
        The corrected p-values, in the same order.

    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".
    """
    adjusted = np.array(p_values, dtype=np.float64)
    made = np.flatnonzero(~np.isnan(adjusted))
    order = made[np.argsort(adjusted[made], kind="stable")]
    stepped = adjusted[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1)
    return adjusted


# Which of two agents is ahead: the exact rank-sum test, guarded against unequal spreads.

# Up to this many scores of both agents together, the null distribution is exact; above, it is
# normal, corrected for ties.
MOST_COUNTED = 40


def ahead_p_value(first: Floats, second: Floats) -> float:
    """The one-sided p-value of "a run of ``first`` scores higher more often than not".

    The larger of two p-values. The first is the rank-sum test's, which is exact where both agents'
    scores have the same distribution, whatever that is. The second asks whether the share of won
    pairs could be a half although the distributions differ, as where one agent is steady and the
    other either far above or far below: see ``share_p_value``.

    Args:
        first: shape (n,), finite.
        second: shape (m,), finite; the runs need not be paired.

    Returns:
        The p-value; NaN where an agent has no score.

    Source: Mann and Whitney (1947); Lehmann (1975), "Nonparametrics", sections 1.4 and 1.5.
    """
    if min(len(first), len(second)) == 0:
        return float("nan")
    return max(rank_sum_p_value(first, second), share_p_value(first, second))


def apart_p_value(first: Floats, second: Floats) -> float:
    """The two-sided p-value of "one of the two is ahead".

    It is doubled because both claims can be wrong, as for a fair coin against an agent that always
    scores half-way between the two sides.
    """
    if min(len(first), len(second)) == 0:
        return float("nan")
    return min(2 * ahead_p_value(first, second), 2 * ahead_p_value(second, first), 1.0)


def equivalent_p_value(first: Floats, second: Floats, margin: float) -> float:
    """The p-value of "neither is ahead by more than ``margin`` in more than half of the pairs".

    Two one-sided tests, each agent in turn with ``margin`` added to its scores.
    """
    return max(ahead_p_value(first + margin, second), ahead_p_value(second + margin, first))


def rank_sum_p_value(first: Floats, second: Floats) -> float:
    """The one-sided p-value of the rank-sum test for "``first`` is ahead"."""
    ranks, ties = doubled_ranks(np.concatenate([first, second]))
    found = int(ranks[: len(first)].sum())
    if len(ranks) <= MOST_COUNTED:
        return float(rank_sum_tail(ties, len(first))[found])
    return _normal_tail(ranks, len(first), len(second), found)


def share_p_value(first: Floats, second: Floats) -> float:
    """The p-value of the share of won pairs, if the true share is a half.

    A binomial test with the effective number of comparisons: as many independent ones as have the
    estimated variance of the share, but no fewer than there are seeds. The p-value is at least
    1 / 2**n for n seeds: so often all runs of an erratic agent with two peaks lie above a steady
    agent in the middle.

    Source: the variance is that of DeLong, DeLong and Clarke-Pearson (1988); the binomial with an
    effective number of comparisons follows Korn and Graubard (1998), "Confidence intervals for
    proportions with small expected number of positive counts", Survey Methodology 24(2).
    """
    n = min(len(first), len(second))
    ahead, behind = wins_of(first, second) / len(second), wins_of(second, first) / len(first)
    share = float(ahead.mean())
    if n < 2 or share <= 0.5:
        return 1.0
    variance = sum(float(wins.var(ddof=1)) / len(wins) for wins in (ahead, behind))
    effective = max(n, share * (1 - share) / variance) if variance > 0 else n
    won = share * effective
    return max(float(special.betainc(won, effective - won + 1, 0.5)), 0.5**n)


def wins_of(values: Floats, others: Floats) -> Floats:
    """How many of the others each value beats, equal ones counting half."""
    slack = np.where(np.isfinite(values), SAME * np.abs(values), 0.0)
    ordered = np.sort(others)
    below = np.searchsorted(ordered, values - slack, side="left")
    up_to = np.searchsorted(ordered, values + slack, side="right")
    return np.asarray((below + up_to) / 2)


def doubled_ranks(scores: Floats) -> tuple[Floats, tuple[int, ...]]:
    """Twice the rank of each score, an integer also for ties, and the sizes of groups of ties."""
    order = np.argsort(scores, kind="stable")
    ordered = scores[order]
    new = np.diff(ordered) > SAME * np.maximum(np.abs(ordered[1:]), np.abs(ordered[:-1]))
    group = np.concatenate([[0], np.cumsum(new)])
    sizes = np.bincount(group)
    ranks = np.empty(len(scores), dtype=np.int64)
    ranks[order] = (2 * np.cumsum(sizes) - sizes + 1)[group]
    return ranks.astype(np.float64), tuple(sizes.tolist())


@lru_cache(maxsize=4096)
def rank_sum_tail(ties: tuple[int, ...], n: int) -> Floats:
    """For each doubled rank sum of ``n`` of the scores, the probability of at least that sum.

    Dynamic programming over groups of equal scores: the number of ways to take some number of
    scores with some rank sum from the groups so far.
    """
    total = sum(ties)
    ways = np.zeros((n + 1, total * (total + 1) + 1))
    ways[0, 0] = 1
    below = 0
    for size in ties:
        rank = 2 * below + size + 1
        below += size
        more = ways.copy()
        for taken in range(1, min(size, n) + 1):
            earlier = ways[: n + 1 - taken, : ways.shape[1] - taken * rank]
            more[taken:, taken * rank :] += math.comb(size, taken) * earlier
        ways = more
    return np.asarray(ways[n, ::-1].cumsum()[::-1] / ways[n].sum())


def _normal_tail(ranks: Floats, n: int, m: int, found: int) -> float:
    """The same for many scores: the normal approximation with a continuity correction."""
    total = n + m
    spread = math.sqrt(n * m / (total * (total - 1)) * float(((ranks - ranks.mean()) ** 2).sum()))
    if spread == 0:
        return 1.0
    step = np.gcd.reduce(np.diff(np.unique(ranks)).astype(np.int64))
    return float(stats.norm.sf((found - n * (total + 1) - step / 2) / spread))


@lru_cache(maxsize=4096)
def interval_places(n: int, m: int, level: float) -> tuple[int, int] | None:
    """Where the interval of the median of n m sorted differences ends; None for too few seeds.

    It inverts the rank-sum test: where scores differ by a shift, the interval contains the shifts
    that the test does not reject at this level.

    Source: Hodges and Lehmann (1963), "Estimates of location based on rank tests"; Lehmann (1975),
    "Nonparametrics", section 2.6.
    """
    if 0.5 ** min(n, m) > level:
        return None
    if n + m <= MOST_COUNTED:
        chances = rank_sum_tail((1,) * (n + m), n)
        # From the largest rank sum down, one won pair fewer at each step of two.
        tails = chances[n * (n + 1 + 2 * m) :: -2][: n * m + 1]
        cut = int((2 * tails <= level).sum())
    else:
        spread = (n * m * (n + m + 1) / 12) ** 0.5
        cut = int(n * m / 2 - stats.norm.isf(level / 2) * spread)
    return (cut - 1, n * m - cut) if cut >= 1 else None
