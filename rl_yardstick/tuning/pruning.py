"""Pruning rules: decide from scores whether a trial is hopeless after some of its seeds.

All trials use the same seeds in the same shuffled order, so that any two trials are compared seed
by seed. Higher scores are better; costs are passed with the opposite sign. docs/search-spaces.md
reports the savings and errors of each rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from rl_yardstick.pipeline.errors import unknown

Scores = Mapping[int, float]  # by seed
Value = Callable[[Sequence[float]], float]

# The smallest numbers of seeds and of other trials for a decision.
MIN_SEEDS, MIN_OTHERS = 2, 4
# The level of a test that a trial is worse than the best one, as in Optuna's WilcoxonPruner.
P_THRESHOLD = 0.1
# One of three settings continues.
REDUCTION = 3
# With at least this number of seeds, a rank test can decide before most seeds are done.
SEEDS_FOR_RANKS = 10


@dataclass(frozen=True)
class Race:
    """A trial among others."""

    scores: Scores  # of the trial so far
    others: Sequence[Scores]  # of ended and running trials
    n_seeds: int  # number of seeds of a complete trial
    value: Value  # the value of several scores
    ceiling: float  # the highest possible score; minus infinity if unknown

    @property
    def own(self) -> float:
        """The trial's value so far."""
        return self.value([*self.scores.values()])

    @property
    def theirs(self) -> list[float]:
        """The values on the trial's seeds of all others that have done them."""
        having = [each for each in self.others if self.scores.keys() <= each.keys()]
        return [self.value([each[seed] for seed in self.scores]) for each in having]

    @property
    def best(self) -> Scores:
        """The best complete trial; empty if there is none. Running trials may have been lucky."""
        whole = [each for each in self.others if len(each) == self.n_seeds]
        return max(whole, key=lambda each: self.value([*each.values()]), default={})

    @property
    def lead(self) -> Sequence[float]:
        """The trial's score minus the best one's by seed; empty if the trial is not behind."""
        best = self.best
        lead = [score - best[seed] for seed, score in self.scores.items() if seed in best]
        return lead if len(lead) >= MIN_SEEDS and sum(lead) < 0 else []


def is_hopeless(
    scores: Scores,
    others: Sequence[Scores],
    method: str = "auto",
    value: Value = fmean,
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
    n_seeds = max(map(len, others), default=0) if n_seeds is None else n_seeds
    return len(scores) > 0 and PRUNERS[method](Race(scores, others, n_seeds, value, ceiling))


def below_median(race: Race) -> bool:
    """Whether the trial is below the median of the others on the same seeds.

    Source: the median stopping rule of Golovin et al. (2017), "Google Vizier", KDD.
    """
    enough = len(race.scores) >= MIN_SEEDS and len(race.theirs) >= MIN_OTHERS
    return enough and race.own < float(np.median(race.theirs))


def out_of_the_race(race: Race) -> bool:
    """Whether the trial is not among the best third at a rung of 1, 3, 9, ... seeds.

    Source: asynchronous successive halving, Li et al. (2020), "A system for massively parallel
    hyperparameter tuning", MLSys.
    """
    theirs, n = race.theirs, len(race.scores)
    if n not in (REDUCTION**k for k in range(n)) or len(theirs) < MIN_OTHERS:
        return False
    n_better = sum(other > race.own for other in theirs)
    return n_better >= max(1, (len(theirs) + 1) // REDUCTION)


def worse_by_ranks(race: Race) -> bool:
    """Whether a signed-rank test on the common seeds finds the trial worse than the best one.

    Source: Wilcoxon (1945); as Optuna's WilcoxonPruner.
    """
    from scipy.stats import wilcoxon

    if not (lead := race.lead):
        return False
    return bool(wilcoxon(lead, alternative="less", zero_method="zsplit").pvalue < P_THRESHOLD)


def cannot_win(race: Race) -> bool:
    """Whether the trial stays below the best one even with perfect scores on all other seeds.

    A perfect score is the highest possible one, or else the highest of any trial. If that bound
    holds, this is the only rule that never ends a trial that would have been chosen.
    """
    best, missing = race.best, race.n_seeds - len(race.scores)
    if not best or missing <= 0:
        return False
    seen = (max(each.values()) for each in (*race.others, race.scores) if each)
    perfect = max(race.ceiling, *seen)
    at_most = race.value([*race.scores.values()] + [perfect] * missing)
    to_beat = race.value([*best.values()])
    return at_most < to_beat - 1e-9 * max(1.0, abs(to_beat))


PRUNERS: Mapping[str, Callable[[Race], bool]] = {
    "auto": lambda race: (
        cannot_win(race) or (race.n_seeds >= SEEDS_FOR_RANKS and worse_by_ranks(race))
    ),
    "none": lambda race: False,
    "bound": cannot_win,
    "median": below_median,
    "halving": out_of_the_race,
    "wilcoxon": worse_by_ranks,
}
