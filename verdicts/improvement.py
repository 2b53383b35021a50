"""How often an agent beats another."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.bootstrap import (
    N_RESAMPLES,
    as_columns,
    check_confidence,
    interval_tail,
    percentile_interval,
    resample_counts,
)
from verdicts.estimates import Estimate
from verdicts.paired import differences, same_shape
from verdicts.rank_tests import wins_of
from verdicts.score_arrays import Counts, Floats

# From here on the bootstrap and the normal interval look the same.
MANY_SEEDS = 200


def probability_of_improvement(
    first: ArrayLike,
    second: ArrayLike,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> Estimate:
    """The probability that a run of the first agent scores higher than one of the second.

    It is the share of all pairs of runs, equal scores counting half: the statistic of Mann and
    Whitney. Over several environments it is the mean of theirs. Both agents' seeds are resampled
    together, as they were run on the same random numbers. Where the first agent always won, or
    always lost, resampling cannot show any doubt; the interval is then that of Clopper and Pearson
    for as many independent wins as there are seeds.

    Args:
        first: shape (n_seeds,) or (n_seeds, n_envs).
        second: likewise, the same seeds at the same places. A seed counts where neither is NaN;
            infinite scores are compared as any others.
        seed: of the resampling.
        confidence: of the interval.
        n_resamples: how many resamples it comes from.

    Raises:
        ValueError: for arguments out of range or of another shape.

    Source: Agarwal et al. (2021), section 4.3. The interval is widened for few seeds, see
    ``interval_tail``; with more than ``MANY_SEEDS`` seeds it is the normal one, which resampling
    would take long to agree with.
    """
    check_confidence(confidence)
    x, y = as_columns(first), as_columns(second)
    same_shape(x, y)
    pairs = [_both_known(*pair) for pair in zip(x.T, y.T, strict=True)]
    sizes = [len(first_scores) for first_scores, _ in pairs]
    n, n_missing = sum(sizes), x.size - sum(sizes)
    if min(sizes) == 0:
        return Estimate(np.nan, np.nan, np.nan, n, n_missing)
    # How often each seed wins, through its run of the first agent and through the other's.
    wins = [(wins_of(one, other), len(one) - wins_of(other, one)) for one, other in pairs]
    point = float(np.mean([ahead.sum() / len(ahead) ** 2 for ahead, _ in wins]))
    if point in {0, 1} and min(sizes) > 1:
        sure = ((1 - confidence) / 2) ** (1 / (min(sizes) * len(sizes)))
        low, high = (sure, 1.0) if point else (0.0, 1 - sure)
        return Estimate(point, low, high, n, n_missing)
    # What each seed adds, through both of its runs, decides how far the statistic varies.
    influences = [(ahead + behind) / len(ahead) for ahead, behind in wins]
    if min(sizes) > MANY_SEEDS:
        low, high = _normal_interval(point, influences, confidence)
        return Estimate(point, low, high, n, n_missing)
    tail = interval_tail(influences, confidence)
    rng = np.random.default_rng(seed)
    tables = [_table(*pair) for pair in pairs]
    resampled = [_resampled(each, resample_counts(len(each), n_resamples, rng)) for each in tables]
    ends = percentile_interval(np.mean(resampled, axis=0), tail)
    return Estimate(point, float(ends[0]), float(ends[1]), n, n_missing)


def _normal_interval(
    point: float, influences: list[Floats], confidence: float
) -> tuple[float, float]:
    """The interval from the spread of what each seed adds; the probability stays within 0 and 1.

    Source: DeLong, DeLong and Clarke-Pearson (1988), "Comparing the areas under two or more
    correlated receiver operating characteristic curves", Biometrics 44(3).
    """
    variances = [values.var(ddof=1) / len(values) for values in influences]
    reach = stats.norm.isf((1 - confidence) / 2) * np.sqrt(sum(variances)) / len(influences)
    return max(point - float(reach), 0.0), min(point + float(reach), 1.0)


def _both_known(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """The scores of the seeds where neither is NaN."""
    both = ~np.isnan(first) & ~np.isnan(second)
    return first[both], second[both]


def _table(first: Floats, second: Floats) -> Floats:
    """1 where a run of the first (rows) beats one of the second (columns), 0.5 where equal."""
    return (1 + np.sign(differences(first[:, None], second[None, :]))) / 2


def _resampled(wins: Floats, counts: Counts) -> Floats:
    """The share of wins in each resample, shape (n_resamples,)."""
    return np.asarray(((counts @ wins) * counts).sum(axis=1) / len(wins) ** 2)
