"""Runs that failed, apart from the typical run: few seeds cannot carry both in one figure."""

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

    n_failed: int  #: runs that did
    n: int  #: runs that there are
    most: float  #: the largest share of all runs that is compatible with that


def failure_threshold(baseline: float, typical: float) -> float:
    """The score below which a run failed: half-way from the baseline to ``typical``.

    Args:
        baseline: the score of the best random or constant policy.
        typical: the median score of the agent that has the highest.

    Returns:
        The threshold; NaN where no agent is better than that, so that nothing sets failures apart.
    """
    return (baseline + typical) / 2 if typical > baseline else float("nan")


def count_failures(scores: ArrayLike, threshold: float, level: float = 0.05) -> FailureCount:
    """How many runs score below a threshold, and how large a share of all runs may.

    Args:
        scores: shape (n_seeds,); what is not finite is missing.
        threshold: from ``failure_threshold``.
        level: how often the bound may be too low. For those of several agents to hold together,
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
    """The pairs of agents of which the first is shown to fail more often than the second.

    Fisher's exact test, after Holm's correction over all pairs.

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
