"""Which of two agents is better, and how many seeds it would take to say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from verdicts.bootstrap import N_RESAMPLES
from verdicts.estimates import Estimate
from verdicts.improvement import probability_of_improvement
from verdicts.paired import (
    holm,
    mean_and_spread,
    paired_difference,
    paired_differences,
    paired_test,
)
from verdicts.power import seeds_for_equivalence, seeds_needed
from verdicts.score_arrays import Floats

Verdict = Literal["better", "worse", "equivalent", "undecided"]

_OPPOSITE: dict[Verdict, Verdict] = {
    "better": "worse",
    "worse": "better",
    "equivalent": "equivalent",
    "undecided": "undecided",
}


@dataclass(frozen=True)
class PairComparison:
    """What the seeds say about two agents.

    Attributes:
        first, second: their names.
        difference: mean of first - second over the seeds that both have, with its interval, which
            is not corrected for the number of pairs.
        p_value: of the paired t test.
        adjusted_p_value: the same after Holm's correction over all pairs.
        probability_of_improvement: that a run of the first scores higher than one of the second.
        verdict: on the first: ``equivalent`` where the difference is shown to lie within the
            margin; else ``better`` or ``worse`` by the adjusted p-value; else ``undecided``.
        seeds_needed: where undecided, the number of seeds that would decide with 80 % power if the
            difference is as observed: for equivalence where it lies within the margin, else for
            ``better`` or ``worse``. None where that is more than 10,000, or there are too few
            seeds to say.
    """

    first: str
    second: str
    difference: Estimate
    p_value: float
    adjusted_p_value: float
    probability_of_improvement: Estimate
    verdict: Verdict
    seeds_needed: int | None

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
) -> list[PairComparison]:
    """Compare every two agents, in the order of the mapping.

    Args:
        scores: by agent, shape (n_seeds,), higher is better, the same seeds at the same places. A
            seed counts for a pair where both are finite.
        margin: the largest difference, in the unit of the scores, that does not matter.
        seed: of the resampling.
        confidence: of the intervals; verdicts err with the rest of the probability.
        n_resamples: how many resamples the intervals of the probabilities come from.

    Raises:
        ValueError: for arguments out of range, or scores that do not pair up.

    Source: for equivalence, two one-sided tests: Schuirmann (1987), "A comparison of the two
    one-sided tests procedure and the power approach".
    """
    _check(scores, margin, confidence)
    pairs = list(combinations(scores, 2))
    p_values = np.array([paired_test(scores[one], scores[two]) for one, two in pairs])
    alpha = 1 - confidence
    level = alpha / max(1, np.isfinite(p_values).sum())
    comparisons = []
    for (one, two), p_value, adjusted in zip(pairs, p_values, holm(p_values), strict=True):
        x, y = _paired(scores[one], scores[two])
        verdict = _verdict(x, y, adjusted, margin, alpha)
        comparison = PairComparison(
            first=one,
            second=two,
            difference=paired_difference(x, y, confidence),
            p_value=float(p_value),
            adjusted_p_value=float(adjusted),
            probability_of_improvement=probability_of_improvement(
                x, y, seed=seed, confidence=confidence, n_resamples=n_resamples
            ),
            verdict=verdict,
            seeds_needed=_seeds(x, y, margin, alpha, level) if verdict == "undecided" else None,
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


def _paired(first: ArrayLike, second: ArrayLike) -> Floats:
    """Both agents' scores, shape (2, n_seeds); NaN for both where one is not finite."""
    both = np.array([first, second], dtype=np.float64)
    return np.where(np.isfinite(both).all(axis=0), both, np.nan)


def _verdict(
    first: Floats, second: Floats, adjusted_p_value: float, margin: float, alpha: float
) -> Verdict:
    """Equivalence goes first: within the margin a difference does not matter, however sure."""
    # Both one-sided tests at level alpha succeed where this interval lies inside the margin.
    inner = paired_difference(first, second, 1 - 2 * alpha)
    if -margin <= inner.low and inner.high <= margin:
        return "equivalent"
    if adjusted_p_value < alpha:
        return "better" if inner.point > 0 else "worse"
    return "undecided"


def _seeds(first: Floats, second: Floats, margin: float, alpha: float, level: float) -> int | None:
    """Seeds until the verdict that the observed difference points to."""
    mean, spread = mean_and_spread(paired_differences(first, second))
    if abs(mean) < margin:
        return seeds_for_equivalence(mean, spread, margin, alpha)
    return seeds_needed(mean, spread, level)
