"""Pruning rules: decide from scores whether a trial is hopeless after some of its seeds.

All trials use the same seeds in the same shuffled order, so that any two trials are compared seed
by seed. Higher scores are better; costs are passed with the opposite sign. docs/search-spaces.md
reports the savings and errors of each rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rl_yardstick.pipeline.errors import unknown

Scores = Mapping[int, float]  # by seed
Value = Callable[[Sequence[float]], float]

# The smallest numbers of seeds and of other trials for a decision.
MIN_SEEDS = 2
MIN_OTHERS = 4
# The level of a test that a trial is worse than the best one, as in Optuna's WilcoxonPruner.
P_THRESHOLD = 0.1
# One of three settings continues.
REDUCTION = 3
# With at least this number of seeds, a rank test can decide before most seeds are done.
SEEDS_FOR_RANKS = 10


@dataclass(frozen=True)
class Rivals:
    """The other trials."""

    others: Sequence[Scores]  # scores of ended and running trials
    n_seeds: int  # number of seeds of a complete trial
    value: Value  # the value of several scores
    ceiling: float  # the highest possible score; minus infinity if unknown

    @property
    def best(self) -> Scores:
        """The best complete trial; empty if there is none. Running trials may have been lucky."""
        whole = [each for each in self.others if len(each) == self.n_seeds]
        return max(whole, key=lambda each: self.value([*each.values()]), default={})

    def lead(self, scores: Scores) -> list[float]:
        """The trial's score minus the best one's, on each common seed."""
        best = self.best
        return [score - best[seed] for seed, score in scores.items() if seed in best]

    def values(self, seeds: Scores) -> list[float]:
        """The values on these seeds of all trials that have done them."""
        having = [each for each in self.others if seeds.keys() <= each.keys()]
        return [self.value([each[seed] for seed in seeds]) for each in having]


def mean(scores: Sequence[float]) -> float:
    """Mean of scores."""
    return sum(scores) / len(scores)


def is_hopeless(
    scores: Scores,
    others: Sequence[Scores],
    method: str = "auto",
    value: Value = mean,
    n_seeds: int | None = None,
    ceiling: float = -math.inf,
) -> bool:
    """Whether to end a trial early, by its scores and those of all others; higher is better.

    Args:
        scores: the trial's scores by seed so far.
        others: the same for ended and running trials.
        method: a key of `PRUNERS`.
        value: the value of several scores.
        n_seeds: number of seeds of a complete trial; None for the largest number so far.
        ceiling: the highest possible score; by default, the highest score so far.
    """
    if method not in PRUNERS:
        raise unknown("--pruner: there is none called", method, PRUNERS)
    longest = max(map(len, others), default=0)
    rivals = Rivals(others, longest if n_seeds is None else n_seeds, value, ceiling)
    return len(scores) > 0 and PRUNERS[method](scores, rivals)


def below_median(scores: Scores, rivals: Rivals) -> bool:
    """Whether the trial is below the median of the others on the same seeds.

    Source: the median stopping rule of Golovin et al. (2017), "Google Vizier", KDD.
    """
    theirs = rivals.values(scores)
    enough = len(scores) >= MIN_SEEDS and len(theirs) >= MIN_OTHERS
    return enough and rivals.value([*scores.values()]) < float(np.median(theirs))


def out_of_the_race(scores: Scores, rivals: Rivals) -> bool:
    """Whether the trial is not among the best third at a rung of 1, 3, 9, ... seeds.

    Source: asynchronous successive halving, Li et al. (2020), "A system for massively parallel
    hyperparameter tuning", MLSys.
    """
    n_seeds = 1
    while n_seeds < len(scores):
        n_seeds *= REDUCTION
    theirs = rivals.values(scores)
    if n_seeds != len(scores) or len(theirs) < MIN_OTHERS:
        return False
    own = rivals.value([*scores.values()])
    n_better = sum(other > own for other in theirs)
    return n_better >= max(1, (len(theirs) + 1) // REDUCTION)


def worse_by_ranks(scores: Scores, rivals: Rivals) -> bool:
    """Whether a signed-rank test on the common seeds finds the trial worse than the best one.

    A trial whose mean is not below the best one's always continues.

    Source: Wilcoxon (1945); as Optuna's WilcoxonPruner.
    """
    from scipy.stats import wilcoxon

    differences = rivals.lead(scores)
    if len(differences) < MIN_SEEDS or sum(differences) >= 0:
        return False
    test = wilcoxon(differences, alternative="less", zero_method="zsplit")
    return bool(test.pvalue < P_THRESHOLD)


def worse_by_means(scores: Scores, rivals: Rivals) -> bool:
    """Whether a paired t test on the common seeds finds the trial worse than the best one.

    Source: racing as in Birattari et al. (2002), "A racing algorithm for configuring
    metaheuristics", GECCO, with the t test that irace offers.
    """
    from scipy.stats import t

    differences = np.asarray(rivals.lead(scores))
    if len(differences) < MIN_SEEDS or differences.sum() >= 0:
        return False
    error = differences.std(ddof=1) / np.sqrt(len(differences))
    if error == 0:
        return True
    return bool(t.cdf(differences.mean() / error, len(differences) - 1) < P_THRESHOLD)


def cannot_win(scores: Scores, rivals: Rivals) -> bool:
    """Whether the trial stays below the best one even with perfect scores on all other seeds.

    A perfect score is the highest possible one, or else the highest of any trial. If that bound
    holds, this is the only rule that never ends a trial that would have been chosen.
    """
    best, missing = rivals.best, rivals.n_seeds - len(scores)
    if not best or missing <= 0:
        return False
    seen = (max(each.values()) for each in (*rivals.others, scores) if each)
    perfect = max(rivals.ceiling, *seen)
    at_most = rivals.value([*scores.values()] + [perfect] * missing)
    to_beat = rivals.value([*best.values()])
    return at_most < to_beat - 1e-9 * max(1.0, abs(to_beat))


def no_chance(scores: Scores, rivals: Rivals) -> bool:
    """Whether the trial cannot win, or has many seeds left and is worse by ranks."""
    has_many = rivals.n_seeds >= SEEDS_FOR_RANKS
    return cannot_win(scores, rivals) or (has_many and worse_by_ranks(scores, rivals))


PRUNERS: Mapping[str, Callable[[Scores, Rivals], bool]] = {
    "auto": no_chance,
    "none": lambda scores, rivals: False,
    "bound": cannot_win,
    "median": below_median,
    "halving": out_of_the_race,
    "racing": worse_by_means,
    "wilcoxon": worse_by_ranks,
}
