"""Verdicts on pairs of agents: the tests, corrected for how many there are."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from scipy import stats

from verdicts.paired import differences, holm
from verdicts.rank_tests import ahead_p_value, apart_p_value, equivalent_p_value
from verdicts.score_arrays import Floats

Verdict = Literal["better", "worse", "equivalent", "undecided"]

# Below, nothing is said whatever the scores.
FEWEST_SEEDS = 3


@dataclass(frozen=True)
class Judgement:
    """A verdict and what it stands on.

    Attributes:
        verdict: on the first of the two.
        p_value: of "one of the two is ahead".
        adjusted_p_value: the same after Holm's correction over all pairs.
        equivalence_p_value: of "neither is ahead by more than the margin", likewise corrected.
        certain: whether neither agent depends on chance, so that nothing was to be tested.
    """

    verdict: Verdict
    p_value: float
    adjusted_p_value: float
    equivalence_p_value: float
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

    The sign test, on two sides, over runs in the order of their seeds, those within the margin left
    out.
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
