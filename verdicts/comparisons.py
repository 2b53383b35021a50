"""Which of two agents is better, by how much, and how many seeds it would take to say."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from verdicts.bootstrap import N_RESAMPLES
from verdicts.error_levels import level_of_look
from verdicts.estimates import Estimate
from verdicts.improvement import probability_of_improvement
from verdicts.judgement import Judgement, Verdict, judge_pairs
from verdicts.power import seeds_needed
from verdicts.rank_tests import wins_of
from verdicts.score_arrays import Floats
from verdicts.typical import typical_difference

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
        difference: the median difference between a run of the first and one of the second. The
            intervals of all pairs hold together, and agree with the verdicts.
        p_value: of "one of the two is ahead", by the rank-sum test.
        adjusted_p_value: the same after Holm's correction over all pairs.
        probability_of_improvement: that a run of the first scores higher than one of the second.
        verdict: on the first: ``equivalent`` where neither is shown to be ahead by more than the
            margin in half of the pairs of runs; else ``better`` or ``worse`` by the adjusted
            p-value; else ``undecided``.
        seeds_needed: where undecided, about the number of seeds that would decide at the next look
            with 80 % power if all is as observed. None where that is more than 10,000, or there
            are too few seeds to say.
        certain: whether neither agent depends on chance, so that their scores say all there is.
        n_seeds: how many seeds each of the two had then, those of runs that failed among them.
    """

    first: str
    second: str
    difference: Estimate
    p_value: float
    adjusted_p_value: float
    probability_of_improvement: Estimate
    verdict: Verdict
    seeds_needed: int | None
    certain: bool = False
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
        x, y = scores[one][:n_seeds], scores[two][:n_seeds]
        improvement = probability_of_improvement(
            *_paired(x, y), seed=seed, confidence=confidence, n_resamples=n_resamples
        )
        x, y = x[np.isfinite(x)], y[np.isfinite(y)]
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


def _paired(first: Floats, second: Floats) -> Floats:
    """Both agents' scores, shape (2, n_seeds); NaN for both where one is not finite."""
    both = np.array([first, second])
    return np.where(np.isfinite(both).all(axis=0), both, np.nan)


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
