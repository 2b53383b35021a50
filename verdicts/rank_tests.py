"""Which of two agents is ahead: the exact rank-sum test, guarded against unequal spreads."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy import special, stats

from verdicts.paired import SAME
from verdicts.score_arrays import Floats

# Up to so many scores of both agents together the null distribution is counted out; beyond, it is
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
    """The p-value of "one of the two is ahead", whichever the scores say.

    The rank-sum test is taken on two sides. The other is not: it is there for agents whose
    distributions differ, of which one is ahead, so that only one of the two claims can be wrong.
    """
    if min(len(first), len(second)) == 0:
        return float("nan")
    forward, back = rank_sum_p_value(first, second), rank_sum_p_value(second, first)
    shares = min(share_p_value(first, second), share_p_value(second, first))
    return min(max(2 * min(forward, back), shares), 1.0)


def equivalent_p_value(first: Floats, second: Floats, margin: float) -> float:
    """The p-value of "neither is ahead by more than ``margin`` in more than half of the pairs".

    Two one-sided tests, each agent in turn with ``margin`` added to its scores.
    """
    return max(
        ahead_p_value(first + margin, second),
        ahead_p_value(second + margin, first),
    )


def rank_sum_p_value(first: Floats, second: Floats) -> float:
    """The chance of ranks as high as those of ``first`` if both have the same distribution.

    Given the scores that there are, ties and all: every split of them between the two agents is
    equally likely.
    """
    ranks, ties = doubled_ranks(np.concatenate([first, second]))
    found = int(ranks[: len(first)].sum())
    if len(ranks) <= MOST_COUNTED:
        return float(rank_sum_tail(ties, len(first))[found])
    return _normal_tail(ranks, len(first), len(second), found)


def share_p_value(first: Floats, second: Floats) -> float:
    """The chance of so large a share of won pairs if that of all runs is a half.

    As if the share came from so many independent comparisons as have the variance that was
    estimated for it, but from no fewer than there are seeds. And n seeds cannot give less than
    1 / 2**n: a steady agent in the middle between an erratic one's two peaks lies below all of its
    runs as often as that.

    Source: the variance is that of DeLong, DeLong and Clarke-Pearson (1988); the binomial with an
    effective number of comparisons follows Korn and Graubard (1998), "Confidence intervals for
    proportions with small expected number of positive counts", Survey Methodology 24(2).
    """
    n = min(len(first), len(second))
    ahead, behind = wins_of(first, second) / len(second), wins_of(second, first) / len(first)
    share = float(ahead.mean())
    if n < 2 or share <= 0.5:
        return 1.0
    variance = _variance_of_mean(ahead) + _variance_of_mean(behind)
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
    """Twice the rank of each score, which is whole also for ties, and how many share each rank.

    Scores that agree to twelve digits are equal.
    """
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
    """By doubled rank sum of ``n`` of the scores, the chance of that or a higher one.

    Counted group by group of equal scores: how many ways there are to have taken so many scores,
    of that sum, from the groups so far.
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
    """The same for many scores, with the correction for the steps that rank sums come in."""
    total = n + m
    spread = math.sqrt(n * m / (total * (total - 1)) * float(((ranks - ranks.mean()) ** 2).sum()))
    if spread == 0:
        return 1.0
    step = np.gcd.reduce(np.diff(np.unique(ranks)).astype(np.int64))
    return float(stats.norm.sf((found - n * (total + 1) - step / 2) / spread))


def _variance_of_mean(values: Floats) -> float:
    return float(values.var(ddof=1)) / len(values)
