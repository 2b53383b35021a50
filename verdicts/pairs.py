"""Verdicts on pairs of agents: tests corrected for their number, sizes of effects, power."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.error_levels import level_of_look
from verdicts.rank_tests import (
    ahead_p_value,
    apart_p_value,
    differences,
    equivalent_p_value,
    holm,
    same_shape,
    typical_difference,
    wins_of,
)
from verdicts.resampling import (
    N_RESAMPLES,
    Counts,
    Estimate,
    Floats,
    as_columns,
    check_confidence,
    interval_tail,
    percentile_interval,
    resample_counts,
)

# Nobody runs more; a difference that needs them is as good as none.
MOST_SEEDS = 10_000


def seeds_needed(share: float, level: float = 0.05, power: float = 0.8) -> int | None:
    """About how many seeds the rank-sum test takes to find one agent ahead.

    Args:
        share: the share of pairs of runs that the agent which is ahead wins, ties counting half.
        level: of the one-sided test.
        power: the probability of finding it.

    Returns:
        The number, at least ``fewest_seeds``; None beyond ``MOST_SEEDS``, or where the share is a
        half or less.

    Source: Noether (1987), "Sample size determination for some common nonparametric tests",
    Journal of the American Statistical Association 82(398).
    """
    if not share > 0.5:
        return None
    reach = stats.norm.isf(level) + stats.norm.ppf(power)
    needed = math.ceil(reach**2 / (6 * (share - 0.5) ** 2))
    return max(needed, fewest_seeds(level)) if needed <= MOST_SEEDS else None


def fewest_seeds(level: float) -> int:
    """With how few seeds a claim at this level can be made at all: see ``share_p_value``."""
    return math.ceil(-math.log2(level) - 1e-9)


# Verdicts on pairs of agents: the tests, corrected for how many there are.

Verdict = Literal["better", "worse", "equivalent", "undecided"]

# Below, nothing is said whatever the scores.
FEWEST_SEEDS = 3


@dataclass(frozen=True)
class Judgement:
    """A verdict and what it stands on."""

    verdict: Verdict  #: on the first of the two
    p_value: float  #: of "one of the two is ahead"
    adjusted_p_value: float  #: the same after Holm's correction over all pairs
    equivalence_p_value: float  #: of "neither is ahead by more than the margin", likewise corrected
    #: Whether neither agent depends on chance, so that nothing was to be tested.
    certain: bool = False


def judge_pairs(
    scores: Mapping[str, Floats],
    margin: float,
    level: float,
    certain: Collection[str] = (),
    decided: Mapping[tuple[str, str], Judgement] | None = None,
) -> dict[tuple[str, str], Judgement]:
    """Judge every two agents, in the order of the mapping.

    Args:
        scores: by agent, shape (n_seeds,); what is not finite is a run that is missing.
        margin: the largest difference that does not matter.
        level: the share of studies in which a ``better`` or ``worse`` may be wrong; likewise an
            ``equivalent``.
        certain: the agents that do not depend on chance. Two of these are compared by what they
            score, and no other pair pays for it.
        decided: the pairs that were at an earlier look, in the same order; see ``grow``. They stay
            as they are and leave their part of the error rate to the others: a pair that was found
            apart its part for ``better`` or ``worse``, an equivalent one that for ``equivalent``.
    """
    earlier = dict(decided or {})
    finite = {name: values[np.isfinite(values)] for name, values in scores.items()}
    pairs = list(combinations(finite, 2))
    known = {(a, b) for a, b in pairs if a in certain and b in certain}
    known -= earlier.keys()
    tested = [
        pair
        for pair in pairs
        if pair not in known
        and pair not in earlier
        and min(len(finite[name]) for name in pair) >= FEWEST_SEEDS
    ]
    apart = [apart_p_value(finite[a], finite[b]) for a, b in tested]
    close = [equivalent_p_value(finite[a], finite[b], margin) for a, b in tested]
    settled = [each.verdict == "equivalent" for each in earlier.values() if not each.certain]
    corrected = zip(
        tested,
        apart,
        _corrected(apart, settled.count(True)),
        _corrected(close, settled.count(False)),
        strict=True,
    )
    nothing = Judgement("undecided", np.nan, np.nan, np.nan)
    judged = {**dict.fromkeys(pairs, nothing), **earlier}
    for pair, raw, adjusted, equal in corrected:
        verdict = _verdict(finite[pair[0]], finite[pair[1]], margin, level, adjusted, equal)
        judged[pair] = Judgement(verdict, float(raw), float(adjusted), float(equal))
    for a, b in known:
        judged[a, b] = _known(finite[a], finite[b], margin)
    return judged


def _corrected(p_values: list[float], n_others: int) -> Floats:
    """P-values after Holm's correction, for so many besides that are not rejected."""
    return holm([*p_values, *[1.0] * n_others])[: len(p_values)]


def _verdict(
    first: Floats, second: Floats, margin: float, level: float, apart: float, close: float
) -> Verdict:
    """Equivalence goes first: within the margin a difference does not matter, however sure.

    But not where runs, if only some, are shown to lie further apart than that on one side.
    """
    if close <= level and not apart_beyond(first, second, margin, level):
        return "equivalent"
    if apart <= level:
        return "better" if ahead_p_value(first, second) < 0.5 else "worse"
    return "undecided"


def apart_beyond(first: Floats, second: Floats, margin: float, level: float) -> bool:
    """Whether one agent is ahead by more than the margin more often than the other is.

    The sign test, on two sides, over runs in the order of their seeds.
    """
    n = min(len(first), len(second))
    apart = differences(first[:n], second[:n])
    above, below = int((apart > margin).sum()), int((apart < -margin).sum())
    return bool(2 * stats.binom.sf(max(above, below) - 1, above + below, 0.5) <= level)


def _known(first: Floats, second: Floats, margin: float) -> Judgement:
    if min(len(first), len(second)) == 0:
        return Judgement("undecided", np.nan, np.nan, np.nan)
    apart = float(differences(first[:1], second[:1])[0])
    if abs(apart) <= margin:
        return Judgement("equivalent", 1.0, 1.0, 0.0, certain=True)
    return Judgement("better" if apart > 0 else "worse", 0.0, 0.0, 1.0, certain=True)


# How often an agent beats another.

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
    known = ~np.isnan(x) & ~np.isnan(y)
    pairs = [(one[k], other[k]) for one, other, k in zip(x.T, y.T, known.T, strict=True)]
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


def _table(first: Floats, second: Floats) -> Floats:
    """1 where a run of the first (rows) beats one of the second (columns), 0.5 where equal."""
    return (1 + np.sign(differences(first[:, None], second[None, :]))) / 2


def _resampled(wins: Floats, counts: Counts) -> Floats:
    """The share of wins in each resample, shape (n_resamples,)."""
    return np.asarray(((counts @ wins) * counts).sum(axis=1) / len(wins) ** 2)


# Which of two agents is better, by how much, and how many seeds it would take to say.

_OPPOSITE: dict[Verdict, Verdict] = {
    "better": "worse",
    "worse": "better",
    "equivalent": "equivalent",
    "undecided": "undecided",
}


@dataclass(frozen=True)
class PairComparison:
    """What the seeds say about two agents."""

    first: str  #: the name of one
    second: str  #: the name of the other
    #: The median difference between a run of the first and one of the second. The intervals of all
    #: pairs hold together, and agree with the verdicts.
    difference: Estimate
    p_value: float  #: of "one of the two is ahead", by the rank-sum test
    adjusted_p_value: float  #: the same after Holm's correction over all pairs
    #: That a run of the first scores higher than one of the second.
    probability_of_improvement: Estimate
    #: On the first: ``equivalent`` where neither is shown to be ahead by more than the margin in
    #: half of the pairs of runs; else ``better`` or ``worse`` by the adjusted p-value; else
    #: ``undecided``.
    verdict: Verdict
    #: Where undecided, about the number of seeds that would decide at the next look with 80 %
    #: power if all is as observed. None where that is more than 10,000, or there are too few seeds
    #: to say.
    seeds_needed: int | None
    #: Whether neither agent depends on chance, so that their scores say all there is.
    certain: bool = False
    #: How many seeds each of the two had then, those of runs that failed among them.
    n_seeds: int = 0

    def swapped(self) -> PairComparison:
        """The same comparison seen from the second agent."""
        gap, wins = self.difference, self.probability_of_improvement
        return replace(
            self,
            first=self.second,
            second=self.first,
            difference=replace(gap, point=-gap.point, low=-gap.high, high=-gap.low),
            probability_of_improvement=replace(
                wins, point=1 - wins.point, low=1 - wins.high, high=1 - wins.low
            ),
            verdict=_OPPOSITE[self.verdict],
        )


def compare_pairs(
    scores: Mapping[str, ArrayLike],
    margin: float = 0.0,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
    look: int = 1,
    n_looks: int | None = None,
    certain: Collection[str] = (),
) -> list[PairComparison]:
    """Compare every two agents, in the order of the mapping.

    Args:
        scores: by agent, shape (n_seeds,), higher is better. What is not finite is missing.
        margin: the largest difference, in the unit of the scores, that does not matter.
        seed: of the resampling.
        confidence: of the study: in so many studies no verdict is wrong, over all of its looks.
        n_resamples: how many resamples the intervals of the probabilities come from.
        look: how often the study has been looked at, this time included, each with more seeds.
        n_looks: how many looks there will be; see ``level_of_look``.
        certain: the agents that do not depend on chance; see ``judge_pairs``.

    Raises:
        ValueError: for arguments out of range, or agents with different numbers of seeds.

    Source: for equivalence, two one-sided tests: Schuirmann (1987), "A comparison of the two
    one-sided tests procedure and the power approach".
    """
    _check(scores, margin, confidence)
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in scores.items()}
    level = level_of_look(1 - confidence, look, n_looks)
    last = n_looks is not None and look >= n_looks
    later = level if last else level_of_look(1 - confidence, look + 1, n_looks)
    judged = judge_pairs(arrays, margin, level, certain)
    return describe_pairs(
        {pair: (judgement, len(arrays[pair[0]])) for pair, judgement in judged.items()},
        arrays,
        margin,
        (level, later),
        seed=seed,
        confidence=confidence,
        n_resamples=n_resamples,
    )


def describe_pairs(
    judged: Mapping[tuple[str, str], tuple[Judgement, int]],
    scores: Mapping[str, Floats],
    margin: float,
    levels: tuple[float, float],
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> list[PairComparison]:
    """Say by how much, and of what, pairs of agents were judged to be better, worse or equivalent.

    Args:
        judged: by pair, the judgement, and with how many of the seeds it was made.
        scores: by agent, shape (n_seeds,).
        margin: the largest difference that does not matter.
        levels: the error rates of the look that judged, and of the next.
        seed: of the resampling.
        confidence: of the probabilities of improvement.
        n_resamples: how many resamples their intervals come from.
    """
    n_pairs = max(1, sum(not each.certain for each, _ in judged.values()))
    level, later = (each / n_pairs for each in levels)
    comparisons = []
    for (one, two), (judgement, n_seeds) in judged.items():
        both = np.array([scores[one][:n_seeds], scores[two][:n_seeds]])
        paired = np.where(np.isfinite(both).all(axis=0), both, np.nan)
        improvement = probability_of_improvement(
            *paired, seed=seed, confidence=confidence, n_resamples=n_resamples
        )
        x, y = (values[np.isfinite(values)] for values in both)
        comparison = PairComparison(
            first=one,
            second=two,
            difference=_difference(x, y, margin, level, judgement),
            p_value=judgement.p_value,
            adjusted_p_value=judgement.adjusted_p_value,
            probability_of_improvement=improvement,
            verdict=judgement.verdict,
            seeds_needed=_seeds(x, y, margin, later) if judgement.verdict == "undecided" else None,
            certain=judgement.certain,
            n_seeds=n_seeds,
        )
        comparisons.append(comparison)
    return comparisons


def _check(scores: Mapping[str, ArrayLike], margin: float, confidence: float) -> None:
    if not 0.5 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, it must lie between 0.5 and 1, as 0.95 does")
    if not margin >= 0:
        raise ValueError(f"margin is {margin}, it must be 0 or a positive difference of scores")
    shapes = {name: np.shape(values) for name, values in scores.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"agents have scores of different shapes, {shapes}: give all of them the same seeds, "
            "and NaN for a run that failed"
        )
    for shape in set(shapes.values()):
        if len(shape) != 1:
            raise ValueError(f"scores have shape {shape}, they must have (n_seeds,)")


def _difference(
    first: Floats, second: Floats, margin: float, level: float, judgement: Judgement
) -> Estimate:
    """The typical difference, its interval made to say what the verdict says.

    Holm's correction may decide what an interval that counts all pairs leaves open; the test for
    unequal spreads may leave open what it decides. And who is shown to lie within the margin lies
    within it: Stefansson, Kim and Hsu (1988), "On confidence sets in multiple comparisons".
    """
    found = typical_difference(first, second, level)
    if judgement.certain:
        return replace(found, low=found.point, high=found.point)
    low, high = found.low, found.high
    if judgement.verdict == "better":
        low = max(low, min(found.point, 0.0))
    elif judgement.verdict == "worse":
        high = min(high, max(found.point, 0.0))
    elif judgement.verdict == "equivalent":
        low, high = max(low, -margin), min(high, margin)
    else:
        low, high = min(low, 0.0), max(high, 0.0)
    return found if np.isnan(found.low) else replace(found, low=low, high=high)


def _seeds(first: Floats, second: Floats, margin: float, level: float) -> int | None:
    """Seeds until the verdict that the scores point to."""
    n = min(len(first), len(second))
    if n < 2:
        return None
    close = min(_share(first + margin, second), _share(second + margin, first))
    ahead = max(_share(first, second), _share(second, first))
    within = seeds_needed(close, level) if margin > 0 else None
    guesses = [guess for guess in (within, seeds_needed(ahead, level / 2)) if guess is not None]
    return max(n + 1, min(guesses)) if guesses else None


def _share(first: Floats, second: Floats) -> float:
    """The share of pairs of runs that the first wins."""
    return float(wins_of(first, second).mean()) / len(second)
