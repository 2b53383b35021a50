"""Whether a trial is hopeless after some of its seeds: pure functions of scores.

All trials go through the same seeds in the same shuffled order, so that any two are compared seed
by seed. Scores are the better the higher; a cost is handed over with its sign turned.
docs/search-spaces.md says what each rule saves and errs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import unknown

Scores = Mapping[int, float]  # by seed
Value = Callable[[Sequence[float]], float]

# The least that anything is concluded from.
MIN_SEEDS = 2
MIN_OTHERS = 4
# Of a test that a trial is worse than the best one, as Optuna's WilcoxonPruner has it.
P_THRESHOLD = 0.1
# Of three settings one goes on.
REDUCTION = 3
# From so many seeds on a rank test can tell two settings apart before most are done.
SEEDS_FOR_RANKS = 10


@dataclass(frozen=True)
class Rivals:
    """The other trials."""

    others: Sequence[Scores]  # of ended trials and those under way
    n_seeds: int  # how many a whole trial has
    value: Value  # what scores are worth together
    ceiling: float  # no score is above that; minus infinity where nobody knows

    @property
    def best(self) -> Scores:
        """The best of those with all seeds; one under way may be lucky yet. Empty without any."""
        whole = [each for each in self.others if len(each) == self.n_seeds]
        return max(whole, key=lambda each: self.value([*each.values()]), default={})

    def lead(self, scores: Scores) -> list[float]:
        """By how much a trial is better than the best one on each of the seeds in common."""
        best = self.best
        return [score - best[seed] for seed, score in scores.items() if seed in best]

    def values(self, seeds: Scores) -> list[float]:
        """On these seeds, of those that have them all."""
        having = [each for each in self.others if seeds.keys() <= each.keys()]
        return [self.value([each[seed] for seed in seeds]) for each in having]


def mean(scores: Sequence[float]) -> float:
    """The mean of scores."""
    return sum(scores) / len(scores)


def is_hopeless(
    scores: Scores,
    others: Sequence[Scores],
    method: str = "auto",
    value: Value = mean,
    n_seeds: int | None = None,
    ceiling: float = -math.inf,
) -> bool:
    """Whether to end a trial early, by its scores and those of all others, the higher the better.

    Args:
        scores: of the trial's seeds so far.
        others: the same of ended trials and those under way.
        method: a key of `PRUNERS`.
        value: what scores are worth together.
        n_seeds: how many a whole trial has; None for as many as any has so far.
        ceiling: no score is above that; what has been seen counts where it is not said.
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
    """Whether a signed-rank test on the seeds in common finds the trial worse than the best one.

    A trial whose mean is not below the best one's goes on whatever the test says.

    Source: Wilcoxon (1945); as Optuna's WilcoxonPruner.
    """
    from scipy.stats import wilcoxon

    differences = rivals.lead(scores)
    if len(differences) < MIN_SEEDS or sum(differences) >= 0:
        return False
    test = wilcoxon(differences, alternative="less", zero_method="zsplit")
    return bool(test.pvalue < P_THRESHOLD)


def worse_by_means(scores: Scores, rivals: Rivals) -> bool:
    """Whether a paired t test on the seeds in common finds the trial worse than the best one.

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
    """Whether the trial stays below the best one even if all that is left goes perfectly.

    Perfect is the highest score that there can be, or else that any trial has had. The only rule
    that ends no trial that would have been chosen, as far as that holds.
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
    """Whether the trial cannot win, or has many seeds to come and loses by ranks."""
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
