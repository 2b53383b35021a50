"""Decides from scores whether a trial is hopeless after some of its seeds.

All trials use the same seeds in the same shuffled order, so that any two trials are compared seed
by seed. Higher scores are better; costs are passed with the opposite sign. docs/search-spaces.md
reports the savings and the errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean

Scores = Mapping[int, float]  # by seed
Value = Callable[[Sequence[float]], float]  # of several scores

# The smallest number of seeds for a test, and the level of a test that a trial is worse than the
# best one, as in Optuna's WilcoxonPruner.
MIN_SEEDS, P_THRESHOLD = 2, 0.1
# With at least this number of seeds, a rank test can decide before most seeds are done.
SEEDS_FOR_RANKS = 10


def is_hopeless(
    scores: Scores,
    others: Sequence[Scores],
    value: Value = fmean,
    n_seeds: int | None = None,
    ceiling: float = -math.inf,
) -> bool:
    """Whether to end a trial early, by its scores and those of all others; higher is better.

    Args:
        scores: the trial's scores by seed so far.
        others: the same for ended and running trials.
        value: the value of several scores.
        n_seeds: number of seeds of a complete trial; None for the largest number so far.
        ceiling: the highest possible score; by default, the highest score so far.
    """
    n_seeds = max(map(len, others), default=0) if n_seeds is None else n_seeds
    # Running trials may have been lucky.
    whole = [each for each in others if len(each) == n_seeds]
    best = max(whole, key=lambda each: value([*each.values()]), default=None)
    if not scores or best is None:
        return False
    perfect = max(ceiling, *(max(each.values()) for each in (*others, scores) if each))
    if cannot_win(scores, best, value, n_seeds, perfect):
        return True
    return n_seeds >= SEEDS_FOR_RANKS and worse_by_ranks(scores, best)


def cannot_win(scores: Scores, best: Scores, value: Value, n_seeds: int, perfect: float) -> bool:
    """Whether the trial stays below the best one even with perfect scores on all other seeds.

    If no score is above ``perfect``, this rule never ends a trial that would have been chosen.
    """
    if (missing := n_seeds - len(scores)) <= 0:
        return False
    at_most, to_beat = value([*scores.values()] + [perfect] * missing), value([*best.values()])
    return at_most < to_beat - 1e-9 * max(1.0, abs(to_beat))


def worse_by_ranks(scores: Scores, best: Scores) -> bool:
    """Whether a signed-rank test on the common seeds finds the trial worse than the best one.

    Source: Wilcoxon (1945); as Optuna's WilcoxonPruner.
    """
    from scipy.stats import wilcoxon

    lead = [score - best[seed] for seed, score in scores.items() if seed in best]
    if len(lead) < MIN_SEEDS or sum(lead) >= 0:
        return False
    return bool(wilcoxon(lead, alternative="less", zero_method="zsplit").pvalue < P_THRESHOLD)
