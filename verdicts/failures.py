"""Failed runs, counted apart from typical runs: with few seeds, one figure cannot show both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.rank_tests import holm


@dataclass(frozen=True)
class FailureCount:
    """How many runs failed."""

    n_failed: int  #: the number of failed runs
    n: int  #: the number of all runs
    most: float  #: an upper confidence bound on the probability that a run fails


def failure_threshold(baseline: float, typical: float) -> float:
    """The score below which a run failed: half-way from the baseline to ``typical``.

    Args:
        baseline: the score of the best random or constant policy.
        typical: the highest median score of any agent.

    Returns:
        The threshold; NaN where no agent beats the baseline, so that failures have no meaning.
    """
    return (baseline + typical) / 2 if typical > baseline else float("nan")


def count_failures(scores: ArrayLike, threshold: float, level: float = 0.05) -> FailureCount:
    """Count the runs below a threshold, and bound the probability of such a run.

    Args:
        scores: shape (n_seeds,); non-finite scores are missing.
        threshold: from ``failure_threshold``.
        level: the error rate of the bound. For the bounds of several agents to hold together,
            divide it by their number.

    Source: Clopper and Pearson (1934), "The use of confidence or fiducial limits illustrated in the
    case of the binomial", the upper limit alone.
    """
    values = np.asarray(scores, dtype=np.float64)
    values = values[np.isfinite(values)]
    n, n_failed = len(values), int((values < threshold).sum())
    most = 1.0 if n_failed == n else float(stats.beta.isf(level, n_failed + 1, n - n_failed))
    return FailureCount(n_failed, n, most)


def fail_more_often(
    counts: Mapping[str, FailureCount], level: float = 0.05
) -> list[tuple[str, str]]:
    """The pairs of agents whose first agent is shown to fail more often than the second.

    Fisher's exact test, with Holm's correction over all pairs.

    Args:
        counts: by agent.
        level: the share of studies in which any of the pairs may be wrong.

    Source: Fisher (1935), "The logic of inductive inference".
    """
    pairs = [
        (a, b) if counts[a].n_failed * counts[b].n > counts[b].n_failed * counts[a].n else (b, a)
        for a, b in combinations(counts, 2)
        if min(counts[a].n, counts[b].n) > 0
    ]
    tables = [
        [[each.n_failed, each.n - each.n_failed] for each in (counts[a], counts[b])]
        for a, b in pairs
    ]
    p_values = holm([stats.fisher_exact(table).pvalue for table in tables])
    return [pair for pair, p_value in zip(pairs, p_values, strict=True) if p_value <= level]
